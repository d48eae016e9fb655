#!/usr/bin/env bash
# Makes .venv-models: this project beside the robot models of eight other projects. Does nothing when it is there. The
# models are files, so the packages come without what they ask for, which would take MuJoCo from its version.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.venv-models
pins=(dm_control==1.0.50 gymnasium==1.4.0 gymnasium-robotics==1.4.2 robosuite==1.5.2
  gym-aloha==0.1.5 gym-hil==0.1.14 gym-xarm==0.1.1 metaworld==3.1.1)
./scripts/venv.sh "$dir" requirements/dev.lock
stamp=$dir/.installed-models
want=$(cat "$0" "$dir"/.installed-dev.lock | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing the models of ${pins[*]} into $dir (once; 320 MB)..."
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps "${pins[@]}"
echo "$want" >"$stamp"
