#!/usr/bin/env bash
# Usage: system-packages.sh PACKAGE... Installs the Debian packages that are not there yet, by name.
# Where that is not allowed it says which are missing and exits with 3.
set -euo pipefail
missing=()
for package in "$@"; do
  dpkg-query --show --showformat='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$package")
done
[ ${#missing[@]} -eq 0 ] && exit 0
command -v apt-get >/dev/null || { echo "Missing system packages: ${missing[*]}" >&2; exit 3; }
run=()
if [ "$(id -u)" -ne 0 ]; then
  sudo -n true 2>/dev/null || { echo "Missing system packages: ${missing[*]}. Run: sudo apt-get install ${missing[*]}" >&2; exit 3; }
  run=(sudo -n)
fi
echo "Installing system packages: ${missing[*]}"
"${run[@]}" apt-get update -qq
DEBIAN_FRONTEND=noninteractive "${run[@]}" apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
