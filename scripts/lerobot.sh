#!/usr/bin/env bash
# Usage: lerobot.sh [0.4.4|0.6.1]. Makes .venv-policies, or .venv-policies-0.6.1: this project with LeRobot and a torch,
# for policies that are computed here and for training. Does nothing when it is there. LeRobot 0.4.4 asks for an older
# torch, and both for viewers and drivers that no policy uses, so LeRobot is installed without what it asks for, beside
# what its policies and its datasets do use. So is openpi's own client, which asks for a numpy before 2 and works with
# these. Feetech's SDK is there too: an arm moves by its policies in one environment. So are the two plug-ins by which
# LeRobot's own commands drive a served robot (docs/lerobot.md), and what those commands import at their start.
# 0.6.1 needs Python 3.12 or newer, which PYTHON names.
set -euo pipefail
cd "$(dirname "$0")/.."
version=${1:-0.4.4}
plugins=(--editable plugins/lerobot_robot_strands --editable plugins/lerobot_teleoperator_strands)
imported=()
pins=("lerobot==$version" safetensors==0.8.0 accelerate==1.15.0 datasets==4.8.5 av==15.1.0 einops==0.8.2 gymnasium==1.4.0
  jsonlines==4.0.0 deepdiff==8.6.2 imageio==2.38.1 num2words==0.5.14 termcolor==3.3.0 grpcio==1.85.1
  protobuf==6.33.6 tokenizers==0.22.2)
if [ "$version" = 0.4.4 ]; then
  dir=.venv-policies
  imported=(opencv-python-headless==4.12.0.88 rerun-sdk==0.26.2)
  pins+=(torch==2.13.0 torchvision==0.28.0 transformers==4.57.6 diffusers==0.35.2 huggingface-hub==0.35.3 numpy==2.4.6
    pandas==3.1.1 draccus==0.10.0)
else
  dir=.venv-policies-$version
  export PYTHON=${PYTHON:-python3.12}
  pins+=(torch==2.11.0 torchvision==0.26.0 transformers==5.5.4 diffusers==0.39.0 huggingface-hub==1.33.0 numpy==2.2.6
    pandas==2.3.3 draccus==0.11.6 matplotlib==3.10.7 opencv-python-headless==4.12.0.88)
fi
./scripts/venv.sh "$dir" requirements/dev.lock
stamp=$dir/.installed-lerobot
want=$(cat "$0" requirements/feetech.txt plugins/*/pyproject.toml "$dir"/.installed-dev.lock | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing LeRobot $version and torch into $dir (once; some minutes)..."
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps "${pins[0]}" openpi-client==0.1.2 \
  "${imported[@]}" "${plugins[@]}"
"$dir/bin/pip" install --quiet --disable-pip-version-check "${pins[@]:1}" -r requirements/feetech.txt
# A torchvision for CUDA beside a torch for the CPU fails when it registers operators that no policy uses.
"$dir/bin/python" -c 'import torchvision' 2>/dev/null ||
  : >"$("$dir/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/torchvision/_meta_registrations.py"
"$dir/bin/python" -c 'import torchvision, lerobot.policies.factory' >/dev/null
echo "$want" >"$stamp"
