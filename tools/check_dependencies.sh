#!/bin/sh
# The default tests with the lowest versions that pyproject.toml allows, or with the newest that there are.
#
#   tools/check_dependencies.sh lowest     uv's --resolution lowest-direct
#   tools/check_dependencies.sh newest     no constraints at all
#
# PYTHON=python3          the interpreter; the lowest bounds are those of the oldest supported, 3.11
# GSMAP_VENV=folder       where the environment is made (default: build/dependencies-lowest or -newest)
# Arguments after the first go to pytest.
set -eu
cd "$(dirname "$0")/.."
which=${1:-}
case "$which" in lowest) resolution=lowest-direct ;; newest) resolution=highest ;; *) sed -n '2,10s/^# \{0,1\}//p' "$0" >&2; exit 2 ;; esac
shift
PYTHON=$(command -v "${PYTHON:-python3}")
venv=${GSMAP_VENV:-build/dependencies-$which}
uv=$(PATH=$(dirname "$PYTHON"):$PATH command -v uv || true)
[ -n "$uv" ] || { echo "this needs uv: pip install uv" >&2; exit 1; }
[ -x "$venv/bin/python" ] || "$uv" venv -q --python "$PYTHON" "$venv"
export VIRTUAL_ENV="$PWD/$venv"
case "$venv" in /*) VIRTUAL_ENV=$venv ;; esac
"$uv" pip install -q scikit-build-core nanobind cmake ninja
"$uv" pip install -q --resolution "$resolution" --no-build-isolation -e ".[test]" -e synthetic
"$uv" pip list 2>/dev/null
# Built for this environment, and in the tree: the next test run of another environment builds it again.
PYTHON="$VIRTUAL_ENV/bin/python" tools/build_native.sh >/dev/null
"$VIRTUAL_ENV/bin/python" -m pytest "$@"
