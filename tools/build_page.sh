#!/bin/sh
# Builds the page of `gsmap view` into gsmap/view/built: what its lock file names is fetched by npm, checked by its
# digests, and bundled. Needs Node.js 18 or newer with npm.
#
#   tools/build_page.sh [OUT]     another folder
#   CHECK=1 tools/build_page.sh   the types, the linter and the formatter first
set -eu
cd "$(dirname "$0")/../gsmap/view/page"
command -v npm >/dev/null || { echo "the page needs Node.js with npm (Debian: apt-get install nodejs npm)" >&2; exit 1; }
if [ ! -f node_modules/.package-lock.json ] || [ package-lock.json -nt node_modules/.package-lock.json ]; then
    npm ci --ignore-scripts --no-audit --no-fund --loglevel=error >&2
fi
[ -z "${CHECK:-}" ] || npm run --silent check
node build.mjs "$@"
