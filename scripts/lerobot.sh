#!/usr/bin/env bash
# Makes .venv-policies: this project with LeRobot 0.4.4 and a torch, for policies that are computed here and for training.
# Does nothing when it is there. LeRobot's metadata asks for an older torch, and for viewers and drivers that no policy
# uses, so it is installed without what it asks for, beside what its policies and its datasets do use. So is openpi's own
# client, which asks for a numpy before 2 and works with this one.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.venv-policies
pins=(lerobot==0.4.4 torch==2.13.0 torchvision==0.28.0 transformers==4.57.6 tokenizers==0.22.2 safetensors==0.8.0
  diffusers==0.35.2 accelerate==1.15.0 datasets==4.8.5 huggingface-hub==0.35.3 numpy==2.4.6 pandas==3.1.1 av==15.1.0
  einops==0.8.2 gymnasium==1.4.0 draccus==0.10.0 jsonlines==4.0.0 deepdiff==8.6.2 imageio==2.38.1 num2words==0.5.14
  pyserial==3.5 termcolor==3.3.0 grpcio==1.85.1 protobuf==6.33.6)
./scripts/venv.sh "$dir" requirements/dev.lock
stamp=$dir/.installed-lerobot
want=$(cat "$0" "$dir"/.installed-dev.lock | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing LeRobot 0.4.4 and torch into $dir (once; some minutes)..."
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps "${pins[0]}" openpi-client==0.1.2
"$dir/bin/pip" install --quiet --disable-pip-version-check "${pins[@]:1}"
# A torchvision for CUDA beside a torch for the CPU fails when it registers operators that no policy uses.
"$dir/bin/python" -c 'import torchvision' 2>/dev/null ||
  : >"$("$dir/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/torchvision/_meta_registrations.py"
"$dir/bin/python" -c 'import torchvision, lerobot.policies.factory' >/dev/null
echo "$want" >"$stamp"
