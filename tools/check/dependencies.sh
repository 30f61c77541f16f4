#!/bin/sh
# The default tests with the lowest versions that pyproject.toml allows, or with the newest that there are.
#
#   tools/check/dependencies.sh lowest     uv's --resolution lowest-direct, of what builds gsmap too
#   tools/check/dependencies.sh newest     whatever is newest today
#   tools/check/dependencies.sh lowest --wheel dist/gsmapdb-*-cp311-*_x86_64.whl tests/store
#                                          of a wheel with the extras for servers, and without torch
#
# Of the checkout, torch alone stays where constraints.txt pins it, and as a build without CUDA: where the resolution names
# a CUDA package nothing is installed, and GSMAP_TORCH_INDEX (see tools/setup.sh) or UV_FIND_LINKS can name where a CPU
# build lies.
#
# PYTHON=python3          the interpreter; the lowest bounds are those of the oldest supported, 3.11
# GSMAP_VENV=folder       where the environment is made (default: build/dependencies-lowest or -newest)
# Further arguments go to pytest.
set -eu
cd "$(dirname "$0")/../.."
which=${1:-}
case "$which" in
lowest) resolution=lowest-direct ;;
newest) resolution=highest ;;
*) sed -n '2,16s/^# \{0,1\}//p' "$0" >&2; exit 2 ;;
esac
shift
wheel=
if [ "${1:-}" = --wheel ]; then
    [ -f "${2:-}" ] || { echo "no such wheel: ${2:-}" >&2; exit 2; }
    wheel=$(cd "$(dirname "$2")" && pwd)/$(basename "$2")
    shift 2
fi
PYTHON=$(command -v "${PYTHON:-python3}")
venv=${GSMAP_VENV:-$PWD/build/dependencies-$which}
uv=$(PATH=$(dirname "$PYTHON"):$PATH command -v uv || true)
[ -n "$uv" ] || { echo "this needs uv: pip install uv" >&2; exit 1; }
# uv reads none of pip's settings: where wheels lie and whom to trust hold for both.
[ -z "${PIP_FIND_LINKS:-}" ] || export UV_FIND_LINKS="${UV_FIND_LINKS:-$(echo "$PIP_FIND_LINKS" | tr ' ' ',')}"
[ -z "${PIP_CERT:-}" ] || export SSL_CERT_FILE="${SSL_CERT_FILE:-$PIP_CERT}"
[ -z "${GSMAP_TORCH_INDEX:-}" ] || export UV_INDEX="${UV_INDEX:-$GSMAP_TORCH_INDEX}"
# A version that both indexes have counts wherever it lies, as it does with pip.
export UV_INDEX_STRATEGY=unsafe-best-match

# Made anew: what an earlier run left would satisfy a bound.
"$uv" venv -q --clear --python "$PYTHON" "$venv"
VIRTUAL_ENV=$(cd "$venv" && pwd)
export VIRTUAL_ENV
PATH=$VIRTUAL_ENV/bin:$PATH
install() { "$uv" pip install --resolution "$resolution" "$@"; }

if [ -n "$wheel" ]; then
    # A wheel's dependencies are not direct ones; the checkout's are. The tests' own tools are the newest.
    versions=$VIRTUAL_ENV/versions.txt
    "$uv" pip compile -q --resolution "$resolution" --extra cloud --extra cluster --extra postgres --no-header \
        --no-annotate --python "$VIRTUAL_ENV/bin/python" --output-file "$versions" pyproject.toml
    "$uv" pip install -q -c "$versions" "${wheel}[cloud,cluster,postgres]"
    "$uv" pip install -q -c "$versions" pytest pytest-xdist hypothesis onnx laspy lazrs tokenizers pandas
    "$uv" pip list
    # The tests' tools are imported from the checkout, gsmap from the wheel: what a path file names comes last.
    echo "$PWD" >"$("$VIRTUAL_ENV/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/checkout.pth"
    unset PYTHONPATH
    export GSMAP_TEST_INSTALLED=1
    "$VIRTUAL_ENV/bin/python" -P -c 'import gsmap; print("testing", gsmap.__file__)'
    exec "$VIRTUAL_ENV/bin/python" -P -m pytest -o pythonpath= "$@"
fi

# What builds gsmap: pyproject.toml's own bounds, and cmake's from CMakeLists.txt.
build=$("$PYTHON" -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"])')
cmake=$(sed -n 's/^cmake_minimum_required(VERSION \(.*\))/cmake>=\1/p' CMakeLists.txt)
# shellcheck disable=SC2086  # a list of words on purpose
install -q $build "$cmake" ninja

pin=$(sed -n 's/^torch==/torch==/p' constraints.txt)
[ -n "$pin" ] || { echo "constraints.txt does not pin torch" >&2; exit 1; }
all() { install -c "$VIRTUAL_ENV/torch.txt" --no-build-isolation -e ".[test]" "$@"; }
# A CPU build goes by "+cpu" where there is one beside a CUDA build, and has no name of its own where there is not.
for torch in "$pin+cpu" "$pin"; do
    echo "$torch" >"$VIRTUAL_ENV/torch.txt"
    ! all --dry-run >"$VIRTUAL_ENV/resolved.txt" 2>&1 || break
done
if ! grep -q '^ + torch==' "$VIRTUAL_ENV/resolved.txt"; then cat "$VIRTUAL_ENV/resolved.txt" >&2; exit 1; fi
if cuda=$(grep -E '^ \+ (nvidia|cuda|triton)' "$VIRTUAL_ENV/resolved.txt"); then
    printf '%s would bring a CUDA build; name an index of CPU builds with GSMAP_TORCH_INDEX:\n%s\n' "$pin" "$cuda" >&2
    exit 1
fi
all -q
# Plain path files, as tools/setup.sh leaves them and for its reason.
purelib=$("$VIRTUAL_ENV/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
find "$purelib" -maxdepth 1 -name '*gsmap*.pth' -exec sed -i '/^import /d' {} +
"$uv" pip list
# Built for this environment, and in the tree: the next test run of another environment builds it again.
PYTHON="$VIRTUAL_ENV/bin/python" tools/build_native.sh >/dev/null
"$VIRTUAL_ENV/bin/python" -m pytest "$@"
