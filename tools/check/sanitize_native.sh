#!/bin/sh
# Builds the kernels with AddressSanitizer and UndefinedBehaviourSanitizer in a folder of their own and runs the core of
# the kernels' tests against them, the renderer's once per instruction set this machine has.
# Usage: [PYTHON=python3] tools/check/sanitize_native.sh [pytest arguments]
set -eu
cd "$(dirname "$0")/../.."
PYTHON=${PYTHON:-python3}
"$PYTHON" -m cmake --version >/dev/null 2>&1 && CMAKE="$PYTHON -m cmake" || CMAKE=cmake
BUILD=build/sanitize
FLAGS="-fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g1"
$CMAKE -S . -B $BUILD -DPython_EXECUTABLE="$(command -v "$PYTHON")" -DCMAKE_BUILD_TYPE=Release \
    -DCMAKE_CXX_FLAGS="$FLAGS" -DCMAKE_MODULE_LINKER_FLAGS="$FLAGS" >/dev/null
$CMAKE --build $BUILD -j "$(nproc)"
# A copy of the package with the instrumented module, so that the working tree keeps its fast one.
rm -rf $BUILD/tree
mkdir -p $BUILD/tree
cp -r gsmap $BUILD/tree/gsmap
rm -f $BUILD/tree/gsmap/_native*.so
$CMAKE --install $BUILD --prefix $BUILD/tree >/dev/null
# Leaks are not looked for: the interpreter and torch keep memory to the end on purpose. -P keeps the working tree's own
# package out of the way.
# GSMAP_TEST_INSTALLED: that copy is what is tested, not the checkout.
export PYTHONPATH=$BUILD/tree GSMAP_TEST_INSTALLED=1 ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1
LD_PRELOAD="$(${CXX:-g++} -print-file-name=libasan.so) $(${CXX:-g++} -print-file-name=libubsan.so)"
export LD_PRELOAD
"$PYTHON" -P -c "import gsmap._native as m; assert 'sanitize' in m.__file__, m.__file__"
exec "$PYTHON" -P -m pytest -q -p no:cacheprovider tests/render tests/register/test_register_clique.py \
    tests/register/test_register_surface.py tests/describe/test_describe_grids.py tests/geometry/test_neighbours.py "$@"
