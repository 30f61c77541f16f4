#!/bin/sh
# Check wheels before they are published: their tags, descriptions and contents; then the one for this interpreter, installed
# with the lowest and with the newest versions that pyproject.toml allows, and tested there.
#
#   tools/check/wheels.sh dist/gsmapdb-*.whl                 with tests of the store, the engine and the command line
#   tools/check/wheels.sh dist/gsmapdb-*.whl -- tests/view   with other tests
#
# Needs from the index: auditwheel, twine, check-wheel-contents, abi3audit and uv. PYTHON=python3 is the interpreter.
set -eu
cd "$(dirname "$0")/../.."
PYTHON=$(command -v "${PYTHON:-python3}")
export PYTHON
wheels=
while [ $# -gt 0 ] && [ "$1" != -- ]; do wheels="$wheels $1"; shift; done
[ -n "$wheels" ] || { sed -n '2,8s/^# \{0,1\}//p' "$0" >&2; exit 2; }
if [ $# -gt 0 ]; then shift; else set -- tests/store tests/engine tests/cli; fi

tag=$("$PYTHON" -c 'import sys; print("cp311" if sys.version_info < (3, 12) else "cp312")')
mine=
for wheel in $wheels; do
    auditwheel show "$wheel"
    twine check --strict "$wheel"
    check-wheel-contents "$wheel"
    case "$wheel" in *-abi3-*) abi3audit --strict --verbose "$wheel" ;; esac
    case "$wheel" in *-"$tag"-*_"$(uname -m)".whl) mine=$wheel ;; esac
done
[ -n "$mine" ] || { echo "none of these wheels is for $PYTHON" >&2; exit 1; }
for versions in lowest newest; do
    echo "=== $mine with the $versions versions"
    tools/check/dependencies.sh $versions --wheel "$mine" -q "$@"
done
