#!/bin/sh
# Wheels and what can be known of other machines.
#
#   tools/build_wheels.sh x86_64     a wheel for manylinux x86-64 in dist/ (auditwheel, patchelf): of CPython 3.11, or of
#                                    3.12 and newer, as PYTHON is
#   tools/build_wheels.sh try        that of dist/ installed in a fresh environment and a small map made with it, away from
#                                    the sources
#   tools/build_wheels.sh kernels    the native module compiled for aarch64 by a cross compiler (g++-aarch64-linux-gnu),
#                                    and run under qemu-user against this machine's numbers (tools/check/kernels.py)
#   tools/build_wheels.sh aarch64    a wheel for aarch64 by that cross compiler in dist/; tools/check/bare_install.sh tries it
#
# PYTHON=python3          the interpreter to build for, with what pyproject.toml builds with (and numpy for kernels)
# AARCH64_ROOT=folder     where an aarch64 Python of the same version lies, with numpy in its folder site/; made from
#                         Debian's packages and PyPI's wheel where the variable is not set (needs dpkg and apt-get)
#
# A wheel is tagged by the glibc that it was linked with (manylinux_2_35 on Debian 12: hypotf). One for as many systems as
# possible is built in the manylinux image, where glibc is old: run this in quay.io/pypa/manylinux_2_28_x86_64 (or
# _aarch64, natively: auditwheel then tags that machine's).
set -eu
cd "$(dirname "$0")/.."
PYTHON=$(command -v "${PYTHON:-python3}")
PATH=$(dirname "$PYTHON"):$PATH
export PATH

need() { for tool in "$@"; do command -v "$tool" >/dev/null || { echo "this needs $tool" >&2; exit 1; }; done; }

# The tag of the wheel that $PYTHON builds and installs.
tag() { "$PYTHON" -c 'import sys; print("cp311" if sys.version_info < (3, 12) else "cp312")'; }

wheel() {
    need auditwheel patchelf npm
    rm -rf dist/raw dist/gsmapdb-*-"$(tag)"-*"_$1.whl"
    # The page of gsmap view in it, or no wheel.
    GSMAP_PAGE=REQUIRED "$PYTHON" -m pip wheel -q --no-deps --no-build-isolation -w dist/raw .
    auditwheel repair -w dist dist/raw/gsmapdb-*.whl
    rm -rf dist/raw
    ls -l dist
}

# Python's headers are the same on both machines (64 bits, little endian); symbols are resolved where it is loaded.
cross_wheel() {
    need aarch64-linux-gnu-g++
    suffix=.cpython-311-aarch64-linux-gnu.so
    [ "$(tag)" = cp311 ] || suffix=.abi3.so
    export _PYTHON_HOST_PLATFORM=linux-aarch64
    export CMAKE_ARGS="-DCMAKE_TOOLCHAIN_FILE=$PWD/tools/aarch64.cmake -DNB_SUFFIX=$suffix -DNB_SUFFIX_S=$suffix"
    wheel aarch64
}

try() {
    root=$PWD
    here=$(mktemp -d)
    trap 'rm -rf "$here"' EXIT
    "$PYTHON" -m venv "$here/venv"
    "$here/venv/bin/pip" install -q -c constraints.txt dist/gsmapdb-*-"$(tag)"-*_x86_64.whl
    cd "$here"
    PATH=$here/venv/bin:$PATH
    unset PYTHONPATH
    python - "$root" <<'END'
import sys
from pathlib import Path

import numpy as np

import gsmap
from gsmap.types import Cameras, Gaussians

assert not Path(gsmap.__file__).is_relative_to(sys.argv[1]), gsmap.__file__
built = Path(gsmap.__file__).parent / "view" / "built"
assert all((built / name).is_file() for name in ("index.html", "page.js", "LICENCES.txt")), "the page is not in the wheel"
assert not (built.parent / "page").exists(), "the sources of the page are in the wheel"
assert (Path(gsmap.__file__).parent / "migrations" / "env.py").is_file(), "the migrations are not in the wheel"
rng = np.random.default_rng(0)
count = 2000
cloud = Gaussians(
    means=rng.uniform(-2, 2, (count, 3)).astype(np.float32),
    quats=rng.normal(size=(count, 4)).astype(np.float32),
    log_scales=rng.uniform(-4, -3, (count, 3)).astype(np.float32),
    logit_opacities=rng.uniform(-1, 3, count).astype(np.float32),
    sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
)
gsmap.formats.write("small.ply", cloud)
print(gsmap.__version__, gsmap.__file__)
END
    gsmap --help >/dev/null
    gsmap init small.gsmap
    gsmap ingest small.gsmap small.ply
    gsmap list small.gsmap scenes
    gsmap migrate small.gsmap
    gsmap check small.gsmap
    gsmap view small.gsmap --export small_page
    test -f small_page/page.js -a -f small_page/map.json
    python - <<'END'
import gsmap

with gsmap.map.open("small.gsmap") as m:
    gaussians, cameras = m.read("small")
alpha = gsmap.render.render(gaussians, cameras[0]).alpha[0]
print(f"rendered: alpha up to {float(alpha.max()):.2f}")
assert 0.1 < float(alpha.max()) <= 1
END
}

arm_root() {
    version=$("$PYTHON" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    numpy=$("$PYTHON" -c 'import numpy; print(numpy.__version__)')
    [ ! -e "$root/whole" ] || return 0
    need dpkg apt-get
    rm -rf "$root"
    mkdir -p "$root/apt/lists/partial" "$root/apt/archives/partial"
    : >"$root/apt/status"
    # apt with lists and a status of its own: this machine's are left as they are, and no rights are needed.
    fetch() {
        (cd "$root/apt" && apt-get -qq -o APT::Architecture=arm64 -o APT::Architectures::=arm64 -o Dir::Cache="$PWD" \
            -o Dir::State="$PWD" -o Dir::State::status="$PWD/status" -o APT::Sandbox::User="$(id -un)" "$@")
    }
    fetch update
    fetch download "python$version-minimal" "libpython$version-minimal" "libpython$version-stdlib" \
        libc6 libstdc++6 libgcc-s1 zlib1g libexpat1 libffi8 libssl3 libbz2-1.0 liblzma5 || {
        echo "no packages of Python $version for arm64 here: name a root of another kind with AARCH64_ROOT" >&2
        exit 1
    }
    for deb in "$root"/apt/*.deb; do dpkg -x "$deb" "$root"; done
    rm -rf "$root/apt"
    "$PYTHON" -m pip install -q --no-deps --only-binary=:all: --target "$root/site" --python-version "$version" \
        --platform manylinux_2_28_aarch64 --platform manylinux2014_aarch64 "numpy==$numpy"
    touch "$root/whole"
}

kernels() {
    need cmake aarch64-linux-gnu-g++ qemu-aarch64
    "$PYTHON" -c 'import nanobind, numpy' || { echo "$PYTHON needs nanobind and numpy" >&2; exit 1; }
    build=build/aarch64
    command -v ninja >/dev/null && generator=Ninja || generator="Unix Makefiles"
    cmake -S . -B $build -G "$generator" -DCMAKE_TOOLCHAIN_FILE=tools/aarch64.cmake -DCMAKE_BUILD_TYPE=Release \
        -DPython_EXECUTABLE="$PYTHON" >/dev/null
    cmake --build $build -j "$(nproc)"
    PYTHON="$PYTHON" tools/build_native.sh >/dev/null
    root=${AARCH64_ROOT:-}
    [ -n "$root" ] || { root=$PWD/build/aarch64-root-$("$PYTHON" -c 'import sys; print(sys.implementation.cache_tag)'); arm_root; }
    here=$(mktemp -d)
    trap 'rm -rf "$here"' EXIT
    # The name that the cross build gives it is of this machine.
    cp $build/_native*.so "$here/_native.so"
    aarch64-linux-gnu-readelf -h "$here/_native.so" | grep Machine
    native=$("$PYTHON" -c 'import sysconfig; print("gsmap/_native" + sysconfig.get_config_var("EXT_SUFFIX"))')
    "$PYTHON" tools/check/kernels.py "$native" --write "$here/numbers.npz"
    PYTHONPATH="$root/site" qemu-aarch64 -L "$root" "$root"/usr/bin/python3.[0-9]* tools/check/kernels.py \
        "$here/_native.so" --compare "$here/numbers.npz"
}

case "${1:-}" in
x86_64) wheel x86_64 ;;
try) try ;;
kernels) kernels ;;
aarch64) cross_wheel ;;
*) sed -n '2,20s/^# \{0,1\}//p' "$0" >&2; exit 2 ;;
esac
