#!/usr/bin/env bash
# Makes .venv-registry with the framework's registry service, for the tests that run on it. Does nothing when it is
# there. The service keeps its devices in etcd, which is Debian's.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.venv-registry
stamp=$dir/.installed
want=$(sha256sum <"$0")
./scripts/system-packages.sh etcd-server
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
python=${PYTHON:-python3}
"$python" -c 'import ensurepip, venv' 2>/dev/null || ./scripts/system-packages.sh python3-venv
echo "Installing the registry service into $dir (once)..."
rm -rf "$dir"
"$python" -m venv "$dir"
"$dir/bin/pip" install --quiet --disable-pip-version-check 'device-connect-server[state]==0.2.5' 'device-connect-edge==0.2.5'
echo "$want" >"$stamp"
