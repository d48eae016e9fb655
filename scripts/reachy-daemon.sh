#!/usr/bin/env bash
# Usage: reachy-daemon.sh VERSION. Makes .venv-reachy-VERSION with Pollen's own daemon, for the tests that run on it.
# Does nothing when it is there. The daemon imports GStreamer's bindings even without media, so those come from Debian
# and the interpreter is Debian's own (its prebuilt `gi` fits no other). MuJoCo is added to the newest one only.
set -euo pipefail
cd "$(dirname "$0")/.."
version=$1
dir=.venv-reachy-$version
case $version in
  1.13.0)
    bare=(log-throttling==0.0.3 rustypot==1.13.1)
    wheels=(onnxruntime==1.27.0 fastapi "starlette>=1.3.1,<2" "pydantic>=2.12.5,<3" uvicorn "websockets>=12,<16"
      "numpy>=2.2.5" reachy-mini-rust-kinematics==1.0.3 reachy_mini_motor_controller==1.5.6
      "huggingface-hub>=1.20.1,<2" "aiohttp>=3.14.0" "zeroconf>=0.149.7,<1" psutil pyserial pyusb libusb_package
      pyyaml "requests>=2.33.0" "python-multipart>=0.0.27" jinja2 platformdirs questionary rich toml asgiref
      mujoco==3.3.0)
    ;;
  1.4.1)
    bare=(log-throttling==0.0.3 rustypot==1.4.2)
    wheels=(onnxruntime==1.27.0 fastapi "starlette<1" "pydantic>=2.12.5,<3" uvicorn "websockets>=12,<16"
      "numpy>=2.2.5" reachy-mini-rust-kinematics reachy_mini_motor_controller
      huggingface-hub aiohttp "zeroconf>=0.131,<1" psutil pyserial pyusb libusb_package
      pyyaml requests python-multipart jinja2 platformdirs questionary rich toml asgiref
      "eclipse-zenoh~=1.7.0" scipy opencv-python-headless cv2_enumerate_cameras)
    ;;
  *)
    echo "No recipe for reachy-mini $version; there are 1.13.0 and 1.4.1." >&2
    exit 2
    ;;
esac
stamp=$dir/.installed
want=$(sha256sum <"$0")
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
./scripts/system-packages.sh python3-venv python3-gi gir1.2-glib-2.0 gir1.2-gstreamer-1.0 gir1.2-gst-plugins-base-1.0
echo "Installing reachy-mini $version into $dir (once; about a minute; what pip misses below is left out on purpose)..."
rm -rf "$dir"
/usr/bin/python3 -m venv "$dir"
pip=("$dir/bin/pip" install --quiet --disable-pip-version-check)
"${pip[@]}" --no-deps "reachy-mini==$version" "${bare[@]}"
"${pip[@]}" "${wheels[@]}"
ln -sfn /usr/lib/python3/dist-packages/gi "$("$dir/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/gi"
echo "$want" >"$stamp"
