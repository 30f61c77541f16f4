#!/bin/sh
# Builds gsmap/_native*.so where the sources lie: only what changed, in a build folder that is kept.
# Usage: [PYTHON=python3] tools/build_native.sh
#
# An editable install (tools/setup.sh test) imports what this builds; tests/conftest.py runs it when a source is newer.
set -eu
cd "$(dirname "$0")/.."
PYTHON=${PYTHON:-python3}
PYTHON=$(command -v "$PYTHON")
# The wheels of cmake and ninja where the interpreter has them: as pinned, and the same on every machine.
PATH=$(dirname "$PYTHON"):$PATH
build=build/inplace-$("$PYTHON" -c 'import sys; print(sys.implementation.cache_tag)')
command -v ninja >/dev/null && generator=Ninja || generator="Unix Makefiles"
# Configured for another environment or place (made again, moved): start anew.
configured="$("$PYTHON" -c 'import nanobind, sys; print(sys.prefix, nanobind.__version__)') $PWD $generator"
if [ "$(cat "$build/configured" 2>/dev/null)" != "$configured" ]; then
    rm -rf "$build"
    cmake -S . -B "$build" -G "$generator" -DPython_EXECUTABLE="$PYTHON" -DCMAKE_BUILD_TYPE=Release >/dev/null
    printf '%s' "$configured" >"$build/configured"
fi
cmake --build "$build" -j "$(nproc)"
cmake --install "$build" --prefix . >/dev/null
# Installing keeps the time of an unchanged module: say that it is as new as the sources.
touch gsmap/_native*"$("$PYTHON" -c 'import sysconfig; print(sysconfig.get_config_var("EXT_SUFFIX"))')"
