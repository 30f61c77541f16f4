#!/bin/sh
# Everything CI checks: the README's own test command from a clean clone in a fresh environment, the linters, the types,
# the measures of readability, the types of the page, and the documents (whose commands are run).
#
#   tools/check.sh            a clean clone of what is committed
#   tools/check.sh --here     this checkout as it lies, in its own .venv
set -eu
cd "$(dirname "$0")/.."
if [ -z "${GSMAP_SHARED_DATA:-}" ] && [ -d ../shared/data/house ]; then
    GSMAP_SHARED_DATA=$(cd ../shared/data && pwd)
    export GSMAP_SHARED_DATA
fi
if [ "${1:-}" != --here ]; then
    clone=$(mktemp -d)
    trap 'rm -rf "$clone"' EXIT
    git clone -q . "$clone/gsmap"
    cd "$clone/gsmap"
fi

# The command a reader of the README would type: the fenced line after "<!-- command two -->".
command=$(awk '/<!-- command two -->/ {seen = 1} seen && /^```/ {inside = !inside; if (!inside) exit; next} inside' README.md)
[ -n "$command" ] || { echo "README.md names no test command" >&2; exit 1; }
log=$(mktemp)
status=0
sh -c "$command" >"$log" 2>&1 || status=$?
cat "$log"
# All are run, whatever one of them finds.
.venv/bin/ruff check . || status=1
.venv/bin/ruff format --check . || status=1
.venv/bin/mypy || status=1
.venv/bin/python -m tools.check.readability --no-startup || status=1
CHECK=1 tools/build_page.sh || status=1
PATH=$PWD/.venv/bin:$PATH .venv/bin/python -m tools.make.docs --out build/site || status=1
# The tests' closing line last, so that whoever reads only the end sees it.
grep -E '^=+ .*(passed|failed|error).* =+$' "$log" | tail -n 1
rm -f "$log"
exit "$status"
