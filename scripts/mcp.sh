#!/usr/bin/env bash
# Makes .venv-mcp: this project with the newest MCP SDK, for its tests. Does nothing when it is there. .venv has the newest
# that strands-agents takes.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.venv-mcp
pins=(mcp==2.3.0 mcp-types==2.3.0)
./scripts/venv.sh "$dir" requirements/dev.lock
stamp=$dir/.installed-mcp
want=$(cat "$0" "$dir"/.installed-dev.lock | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing ${pins[*]} into $dir (once)..."
"$dir/bin/pip" install --quiet --disable-pip-version-check --no-deps "${pins[@]}"
echo "$want" >"$stamp"
