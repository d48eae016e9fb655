#!/usr/bin/env bash
# Puts axe-core into .axe, for the test of the operator's page with it. Does nothing when it is there.
set -euo pipefail
cd "$(dirname "$0")/.."
version=4.14.1
[ -f ".axe/axe-$version.min.js" ] && exit 0
command -v npm >/dev/null || ./scripts/system-packages.sh npm
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
(cd "$folder" && npm pack --silent "axe-core@$version" >/dev/null && tar -xzf ./*.tgz package/axe.min.js)
mkdir -p .axe
mv "$folder/package/axe.min.js" ".axe/axe-$version.min.js"
