#!/bin/sh
# Sets gsmap up in .venv beside this checkout: system libraries, environment, native kernels, the page of gsmap view,
# command line.
#
#   tools/setup.sh            what running gsmap needs
#   tools/setup.sh test       what working on it needs: installed editable, so that tests test this checkout as it lies,
#                             with what tests, linters and documents need
#
# PYTHON=/path/to/python3.12     another interpreter (3.11 to 3.14)
# GSMAP_VENV=/path/to/venv       another place for the environment
# GSMAP_TORCH_INDEX=URL          install torch, from this index
set -eu
cd "$(dirname "$0")/.."
venv=${GSMAP_VENV:-.venv}
say() { printf 'gsmap setup: %s\n' "$*" >&2; }
die() { say "$*"; exit 1; }

good_python() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null; }

find_python() {
    for candidate in ${PYTHON:-} python3 python3.14 python3.13 python3.12 python3.11; do
        if command -v "$candidate" >/dev/null && good_python "$candidate"; then command -v "$candidate"; return; fi
    done
}

# --- what only the system can give -----------------------------------------------------------------------------------
python=$(find_python)
packages=""
[ -n "$python" ] || packages="$packages python3"
command -v g++ >/dev/null || packages="$packages g++"
if [ -z "$python" ] || ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then packages="$packages python3-venv"; fi
if [ -z "$python" ] || ! "$python" -c 'import os, sysconfig, sys
sys.exit(not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")))'; then
    packages="$packages python3-dev"
fi
if [ "${1:-}" = test ]; then
    # Libraries of open3d. One that the loader knows is installed, whatever package it came from.
    for pair in libGL.so.1:libgl1 libEGL.so.1:libegl1 libgomp.so.1:libgomp1 libusb-1.0.so.0:libusb-1.0-0; do
        PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null | grep -q "${pair%%:*}" || packages="$packages ${pair##*:}"
    done
fi
# The page of gsmap view is built by Node.js; gsmap does without where it cannot be had.
node=""
command -v npm >/dev/null || node="nodejs npm"
may_install() { command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || command -v sudo >/dev/null; }; }
if [ -n "$node" ] && may_install; then packages="$packages $node"; elif [ -n "$node" ]; then
    say "no Node.js with npm here: gsmap view will be left out; install them and run this again to have it"
fi
# The page's tests are run in a browser; they are skipped, with a reason, where there is none.
if [ "${1:-}" = test ] && ! command -v chromium >/dev/null && ! command -v google-chrome >/dev/null; then
    if may_install; then packages="$packages chromium"; else say "no Chromium here: tests of the page will be skipped"; fi
fi
if [ -n "$packages" ]; then
    command -v apt-get >/dev/null || die "please install the equivalents of:$packages, then run this again"
    if [ "$(id -u)" = 0 ]; then as_root=""; elif command -v sudo >/dev/null; then as_root=sudo; else
        die "please run as root: apt-get install$packages, then run this again"
    fi
    say "installing system packages:$packages"
    $as_root apt-get update -qq
    # shellcheck disable=SC2086  # a list of words on purpose
    DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -qq --no-install-recommends $packages >&2
    python=$(find_python)
fi
[ -n "$python" ] || die "no Python 3.11 to 3.14 found: install one and name it with PYTHON=..."

# --- the environment -------------------------------------------------------------------------------------------------
say "environment $venv with $("$python" --version)"
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
if [ -n "${GSMAP_TORCH_INDEX:-}" ]; then
    "$venv/bin/python" -m pip install -q -c constraints.txt --index-url "$GSMAP_TORCH_INDEX" torch
fi
say "installing packages and building the native kernels (a few minutes)"
pip() { "$venv/bin/python" -m pip "$@"; }
if [ "${1:-}" = test ]; then
    # torch first and by itself: its pin must be settled before another package's open range can pull in a newer one.
    pip install -q -c constraints.txt torch
    # Without isolation: the module is built by the tools that stay in the environment, again and again.
    pip install -q -c constraints.txt scikit-build-core nanobind cmake ninja
    pip install -q -c constraints.txt --no-build-isolation -e ".[test,lint,docs]"
    # Leave plain path files: the import hooks beside them would stand before PYTHONPATH, and a checkout that PYTHONPATH
    # names could not be tested with this environment.
    purelib=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    find "$purelib" -maxdepth 1 -name '*gsmap*.pth' -exec sed -i '/^import /d' {} +
    PYTHON="$venv/bin/python" tools/build_native.sh >&2
    if command -v npm >/dev/null; then tools/build_page.sh; fi
else
    pip install -q -c constraints.txt .
    "$venv/bin/python" -P -c 'from gsmap.view.built import built_page; built_page()' 2>/dev/null ||
        say "the page of gsmap view was left out: GSMAP_PAGE=REQUIRED tools/setup.sh says why"
fi
say "ready: $venv/bin/gsmap --help"
