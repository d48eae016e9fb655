#!/usr/bin/env bash
# Usage: tests.sh PYTHON ARGS... Runs pytest with ARGS.
# Where SECOND_RUN is set, as in CI, up to that many tests that failed beside others run once more, alone and one after
# another. Each is named, because it is a fault to be mended; one that fails again, or one too many, is a failure.
set -uo pipefail
python=$1
shift
most=${SECOND_RUN:-0}
[ "$most" -gt 0 ] || exec "$python" -m pytest "$@"

cache=$(mktemp -d)
trap 'rm -rf "$cache"' EXIT
"$python" -m pytest -o cache_dir="$cache" "$@"
code=$?
[ "$code" -eq 1 ] || exit "$code"
mapfile -t failed < <("$python" -c 'import json, sys; print(*json.load(open(sys.argv[1])), sep="\n")' "$cache/v/cache/lastfailed")
[ "${#failed[@]}" -gt 0 ] && [ "${#failed[@]}" -le "$most" ] || exit "$code"
echo "FAILED ONCE, run again alone:" >&2
printf '  %s\n' "${failed[@]}" >&2
"$python" -m pytest -o cache_dir="$cache" "${failed[@]}" || exit
printf 'PASSED ALONE, failed beside others: %s\n' "${failed[@]}" >&2
