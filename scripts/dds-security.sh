#!/usr/bin/env bash
# Makes .venv-dds-security: this project on a Cyclone DDS that has DDS Security. Does nothing when it is there.
# The wheels of cyclonedds have no security plugins; Debian's library has them, and the binding 0.10.5 is built on it.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.venv-dds-security
lock=requirements/dds-security.lock
stamp=$dir/.installed
want=$(cat "$0" "$lock" | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
python=${PYTHON:-python3}
./scripts/system-packages.sh gcc libc6-dev cyclonedds-dev
"$python" -c 'import ensurepip, venv' 2>/dev/null || ./scripts/system-packages.sh python3-venv
echo "Building cyclonedds on Debian's library in $dir (once; about half a minute)..."
rm -rf "$dir"
"$python" -m venv "$dir"
# The build looks for a prefix with include/, lib/ and bin/; Debian keeps the library in a folder by architecture.
libraries=$(dirname "$(dpkg -L cyclonedds-dev | grep '/libddsc\.so$')")
prefix=$PWD/$dir/cyclonedds
mkdir -p "$prefix/include" "$prefix/lib" "$prefix/bin"
ln -s /usr/include/dds /usr/include/idl "$prefix/include/"
ln -s "$libraries"/libddsc.so* "$libraries"/libcycloneddsidl.so* "$libraries/cmake" "$prefix/lib/"
pip=("$dir/bin/pip" --quiet --disable-pip-version-check install --no-deps)
"${pip[@]}" --require-hashes --only-binary :all: -r <(sed '/^cyclonedds==/,/[^\\]$/d' "$lock")
# From 3.13 on, Python has this function under its public name only.
export CFLAGS=
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 13))' && CFLAGS=-D_Py_IsFinalizing=Py_IsFinalizing
CYCLONEDDS_HOME=$prefix CMAKE_PREFIX_PATH=$prefix "${pip[@]}" --require-hashes --no-build-isolation \
  --no-binary cyclonedds --no-cache-dir -r <(sed -n '/^cyclonedds==/,/[^\\]$/p' "$lock")
"${pip[@]}" --editable .
echo "$want" >"$stamp"
