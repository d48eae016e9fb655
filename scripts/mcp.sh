#!/usr/bin/env bash
# Makes .venv-mcp: this project with version 2 of the official MCP SDK, for `strands-robots mcp`. Does nothing when it is
# there. The framework's own MCP bridge, which .venv has, needs version 1.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.venv-mcp
pins=(mcp==2.1.1 mcp-types==2.1.1 httpx2==2.16.2 httpcore2==2.16.2 truststore==0.10.5)
./scripts/venv.sh "$dir" requirements/dev.lock
stamp=$dir/.installed-mcp
want=$(cat "$0" "$dir"/.installed-dev.lock | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing ${pins[*]} into $dir (once)..."
"$dir/bin/pip" uninstall --quiet --yes fastmcp
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps "${pins[@]}"
echo "$want" >"$stamp"
