#!/bin/sh
# Builds gsmap._native in place (gsmap/_native*.so), for working on the kernels without reinstalling.
# Usage: [PYTHON=python3] tools/build_native.sh
set -eu
cd "$(dirname "$0")/.."
PYTHON=${PYTHON:-python3}
"$PYTHON" -m cmake --version >/dev/null 2>&1 && CMAKE="$PYTHON -m cmake" || CMAKE=cmake
$CMAKE -S . -B build/inplace -DPython_EXECUTABLE="$(command -v "$PYTHON")" -DCMAKE_BUILD_TYPE=Release >/dev/null
$CMAKE --build build/inplace -j "$(nproc)"
$CMAKE --install build/inplace --prefix . >/dev/null
