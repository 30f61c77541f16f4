#!/bin/sh
# Wheels and what can be known of other machines.
#
#   tools/build_wheels.sh x86_64     a wheel for manylinux x86-64 in dist/ (auditwheel, patchelf)
#   tools/build_wheels.sh aarch64    the native module compiled for aarch64 by a cross compiler (g++-aarch64-linux-gnu),
#                                    and run under qemu-user against this machine's numbers (tools/check_kernels.py)
#
# PYTHON=python3          the interpreter to build for
# AARCH64_ROOT=folder     where an aarch64 Python of the same version with numpy lies; made from Debian's packages and
#                         PyPI's wheel where the variable is not set (needs dpkg and apt-get)
#
# A wheel for as many systems as possible is built in the manylinux image, where glibc is old: run this in
# quay.io/pypa/manylinux_2_28_x86_64 (or _aarch64, natively: auditwheel then tags that machine's).
set -eu
cd "$(dirname "$0")/.."
PYTHON=$(command -v "${PYTHON:-python3}")
PATH=$(dirname "$PYTHON"):$PATH
export PATH

wheel() {
    rm -rf dist/raw
    "$PYTHON" -m pip wheel -q --no-deps --no-build-isolation -w dist/raw . ./synthetic
    auditwheel repair -w dist dist/raw/gsmap-*.whl
    mv dist/raw/gsmap_synthetic-*.whl dist/
    auditwheel show dist/gsmap-*manylinux*.whl
    ls -l dist
}

arm_root() {
    root=$PWD/build/aarch64-root
    version=$("$PYTHON" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    if [ ! -e "$root/usr/bin/python$version" ]; then
        mkdir -p "$root/debs"
        dpkg --add-architecture arm64
        apt-get update -qq
        (cd "$root/debs" && for name in "python$version-minimal" "libpython$version-minimal" "libpython$version-stdlib" \
            libc6 libstdc++6 libgcc-s1 zlib1g libexpat1 libffi8 libssl3 libbz2-1.0 liblzma5; do
            apt-get download -qq "$name:arm64"; done)
        dpkg --remove-architecture arm64
        for deb in "$root"/debs/*.deb; do dpkg -x "$deb" "$root"; done
        numpy=$("$PYTHON" -c 'import numpy; print(numpy.__version__)')
        "$PYTHON" -m pip install -q --no-deps --only-binary=:all: --target "$root/site" --python-version "$version" \
            --platform manylinux_2_28_aarch64 --platform manylinux2014_aarch64 "numpy==$numpy"
    fi
}

arm() {
    build=build/aarch64
    command -v ninja >/dev/null && generator=Ninja || generator="Unix Makefiles"
    # Python's headers are the same on both machines (64 bits, little endian); symbols are resolved where it is loaded.
    cmake -S . -B $build -G "$generator" -DCMAKE_TOOLCHAIN_FILE=tools/aarch64.cmake -DCMAKE_BUILD_TYPE=Release \
        -DPython_EXECUTABLE="$PYTHON" >/dev/null
    cmake --build $build -j "$(nproc)"
    module=$(ls $build/_native*.so)
    aarch64-linux-gnu-readelf -h "$module" | grep Machine
    [ -n "${AARCH64_ROOT:-}" ] && root=$AARCH64_ROOT || arm_root
    here=$(mktemp -d)
    trap 'rm -rf "$here"' EXIT
    cp "$module" "$here/_native.so"
    "$PYTHON" tools/check_kernels.py gsmap/_native*.so --write "$here/numbers.npz"
    PYTHONPATH="$root/site" qemu-aarch64 -L "$root" "$root"/usr/bin/python3.* tools/check_kernels.py "$here/_native.so" \
        --compare "$here/numbers.npz"
}

case "${1:-}" in
x86_64) wheel ;;
aarch64) arm ;;
*) sed -n '2,14s/^# \{0,1\}//p' "$0" >&2; exit 2 ;;
esac
