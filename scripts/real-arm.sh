#!/usr/bin/env bash
# Usage: real-arm.sh [0.4.4|0.6.1]. Makes .venv-lerobot, or .venv-lerobot-0.6.1: this project with LeRobot's own
# SO-100/SO-101 driver and without torch. Does nothing when it is there. LeRobot's metadata asks for torch and a hundred
# packages more that its motor drivers never use, so it is installed without what it asks for, beside the few that they do
# use. 0.6.1 needs Python 3.12 or newer, which PYTHON names.
set -euo pipefail
cd "$(dirname "$0")/.."
version=${1:-0.4.4}
dir=.venv-lerobot
draccus=0.10.0 hub=0.35.3
if [ "$version" != 0.4.4 ]; then
  dir=.venv-lerobot-$version draccus=0.11.6 hub=1.33.0
  export PYTHON=${PYTHON:-python3.12}
fi
pins=("lerobot==$version" "draccus==$draccus" mergedeep==1.3.4 pyyaml-include==1.4.1
  toml==0.10.2 typing-inspect==0.9.0 deepdiff==8.6.2 orderly-set==5.5.0 tqdm==4.70.1 termcolor==3.3.0
  "huggingface-hub==$hub" filelock==4.2.11 fsspec==2026.9.0 requests==2.34.2 charset-normalizer==3.5.2)
./scripts/venv.sh "$dir" requirements/dev.lock
stamp=$dir/.installed-real-arm
want=$(cat "$0" requirements/feetech.txt "$dir"/.installed-dev.lock | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing LeRobot's arm driver $version into $dir (once)..."
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps "${pins[@]}" -r requirements/feetech.txt
echo "$want" >"$stamp"
