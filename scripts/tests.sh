#!/usr/bin/env bash
# Usage: tests.sh PYTHON ARGS... Runs pytest with ARGS.
# Where SECOND_RUN names a file with a number, as in CI, tests that failed beside others run once more, alone and one
# after another, while the number lasts; each takes one off it. Each is named, because it is a fault to be mended. One
# that fails again, one too many, or a unit test of safety is a failure at once.
set -uo pipefail
# Some hundred processes are started; where the shell forbids bytecode, each would compile the package anew.
unset PYTHONDONTWRITEBYTECODE
python=$1
shift
[ -f "${SECOND_RUN:-}" ] || exec "$python" -m pytest "$@"

cache=$(mktemp -d)
trap 'rm -rf "$cache"' EXIT
"$python" -m pytest -o cache_dir="$cache" "$@"
code=$?
[ "$code" -eq 1 ] || exit "$code"
mapfile -t failed < <("$python" -c 'import json, sys; print(*json.load(open(sys.argv[1])), sep="\n")' "$cache/v/cache/lastfailed")
left=$(($(cat "$SECOND_RUN") - ${#failed[@]}))
[ "${#failed[@]}" -gt 0 ] && [ "$left" -ge 0 ] || exit "$code"
printf '%s\n' "${failed[@]}" | grep -q '^tests/safety/' && exit "$code"
echo "$left" >"$SECOND_RUN"
echo "FAILED ONCE, run again alone:" >&2
printf '  %s\n' "${failed[@]}" >&2
"$python" -m pytest -o cache_dir="$cache" "${failed[@]}" || exit
printf 'PASSED ALONE, failed beside others: %s\n' "${failed[@]}" >&2
