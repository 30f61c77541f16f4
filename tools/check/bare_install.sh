#!/bin/sh
# Install a wheel in a bare system and run `gsmap demo` there: python3 and venv, no compiler, no Node.js, no further
# package. Prints the CPU seconds of both, and what takes the space. Needs root, and mmdebstrap or debootstrap.
#
#   tools/check/bare_install.sh dist/gsmapdb-*.whl                     Debian 12
#   tools/check/bare_install.sh dist/gsmapdb-*.whl noble http://archive.ubuntu.com/ubuntu
#
# A wheel of another machine (aarch64) is run under qemu-user (Debian: qemu-user-static, registered as a binfmt). The demo
# would take an hour there: the smallest pair is registered instead, on both machines (tools/check/pair.py).
#
# BARE_ROOT=folder     keep the system there, and use it again
# PYTHON=python3       with gsmap, for the pair on this machine
set -eu
[ -f "${1:-}" ] || { sed -n '2,13s/^# \{0,1\}//p' "$0" >&2; exit 2; }
wheel=$1 suite=${2:-bookworm} mirror=${3:-http://deb.debian.org/debian}
if [ -n "${BARE_ROOT:-}" ]; then root=$BARE_ROOT; else root=$(mktemp -d) && trap 'rm -rf "$root"' EXIT; fi
packages=python3,python3-venv,ca-certificates arch=
case "$wheel" in *_"$(uname -m)".whl) ;; *_aarch64.whl) arch=--arch=arm64 ;; esac
if [ ! -x "$root/usr/bin/python3" ]; then
    # Ubuntu has venv in universe; its keys are not on every Debian.
    case "$mirror" in *ubuntu*) parts=main,universe check=--no-check-gpg ;; *) parts=main check= ;; esac
    if command -v debootstrap >/dev/null; then
        # A debootstrap older than the release has no script of its name; those of one distribution are the same.
        script=
        [ -e "/usr/share/debootstrap/scripts/$suite" ] || script=/usr/share/debootstrap/scripts/gutsy
        # shellcheck disable=SC2086  # empty where keys are checked
        debootstrap $check $arch --variant=minbase --components="$parts" --include="$packages" "$suite" "$root" "$mirror" \
            $script >&2
    else
        # shellcheck disable=SC2086
        mmdebstrap $arch --variant=minbase --components="$parts" --include="$packages" "$suite" "$root" "$mirror" >&2
    fi
fi
cp /etc/resolv.conf "$root/etc/resolv.conf"
[ -z "${PIP_CERT:-}" ] || cp "$PIP_CERT" "$root/etc/ssl/certs/ca-certificates.crt"
rm -rf "$root/try"
mkdir "$root/try"
cp "$wheel" "$root/try/"
if [ -n "$arch" ]; then
    here=$(dirname "$0")
    # Of the instruction sets, the one that every machine has.
    GSMAP_INSTRUCTION_SET=baseline "${PYTHON:-python3}" "$here/pair.py" "$root/try/pair"
    mv "$root/try/pair/edge.json" "$root/try/expected.json"
    cp "$here/pair.py" "$root/try/"
fi
cat >"$root/try/run.sh" <<'RUN'
set -eu
cd /try
for tool in cc gcc g++ node npm; do if command -v $tool >/dev/null; then echo "$tool is installed" >&2; exit 1; fi; done
python3 -m venv venv
. venv/bin/activate
cat >measure.py <<'PY'
import os, subprocess, sys
subprocess.run(sys.argv[2:], check=True)
spent = os.times()
print(f"{sys.argv[1]}: {spent.children_user + spent.children_system:.0f} CPU s", flush=True)
PY
python measure.py install pip install -q --no-cache-dir --only-binary :all: ./*.whl
gsmapdb --version
if [ -e expected.json ]; then
    python measure.py pair python pair.py pair --compare expected.json
else
    python measure.py demo gsmap demo demo
    gsmap list demo/demo.gsmap edges
    gsmap view demo/demo.gsmap --export page >/dev/null
    test -s page/page.js
fi
cd venv/lib/python3*/site-packages
echo "installed: $(du -sm . | cut -f1) MB, of which"
du -sm -- * | sort -rn | head -n 16
RUN
env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 chroot "$root" sh /try/run.sh
