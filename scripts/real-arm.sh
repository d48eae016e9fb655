#!/usr/bin/env bash
# Makes .venv-lerobot: this project with LeRobot's own SO-100/SO-101 driver and without torch. Does nothing when it is
# there. LeRobot's metadata asks for torch and a hundred packages more that its motor drivers never use, so it is
# installed without what it asks for, beside the few that they do use.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.venv-lerobot
pins=(lerobot==0.4.4 feetech-servo-sdk==1.0.0 pyserial==3.5 draccus==0.10.0 mergedeep==1.3.4 pyyaml-include==1.4.1
  toml==0.10.2 typing-inspect==0.9.0 deepdiff==8.6.2 orderly-set==5.5.0 tqdm==4.70.1 termcolor==3.3.0
  huggingface-hub==0.35.3 filelock==4.2.11 fsspec==2026.9.0 requests==2.34.2 charset-normalizer==3.5.2)
./scripts/venv.sh "$dir" requirements/dev.lock
stamp=$dir/.installed-real-arm
want=$(cat "$0" "$dir"/.installed-dev.lock | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing LeRobot's arm driver into $dir (once)..."
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps "${pins[@]}"
echo "$want" >"$stamp"
