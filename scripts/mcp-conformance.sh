#!/usr/bin/env bash
# Makes .mcp-conformance with the official conformance tests of MCP and the Node that they need, both from npm. Does
# nothing when it is there.
set -euo pipefail
cd "$(dirname "$0")/.."
dir=.mcp-conformance
packages=()
command -v node >/dev/null || packages+=(nodejs)
command -v npm >/dev/null || packages+=(npm)
[ ${#packages[@]} -eq 0 ] || ./scripts/system-packages.sh "${packages[@]}"
stamp=$dir/.installed
want=$(sha256sum <"$0")
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing the conformance tests of MCP into $dir (once)..."
rm -rf "$dir"
mkdir "$dir"
# The newest protocol revision, 2026-07-28, has its scenarios in an alpha only.
(cd "$dir" && npm install --no-audit --no-fund --loglevel=error node@22.23.3 @modelcontextprotocol/conformance@0.1.16 \
  conformance-next@npm:@modelcontextprotocol/conformance@0.2.0-alpha.12)
echo "$want" >"$stamp"
