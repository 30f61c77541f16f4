#!/usr/bin/env bash
# Proves the CUDA backend on a machine with a GPU, without a network, in under nine minutes: installs what is missing
# from wheels that lie in a folder, builds gsplat's kernels for this GPU alone where no built wheel is there, builds
# gsmap's native module, runs the tests that need a GPU, then tools/bench/gpu.py, most telling parts first.
#
#   tools/check/gpu.sh WHEELS CAPTURES OUT [PART ...]
#   tools/check/gpu.sh --dry-run CAPTURES OUT     on the CPU, in this environment: that all of it runs
#
# WHEELS     folder of wheels: gsplat (or its sources, any wheel with csrc/) and what gsmap needs and this machine lacks
# CAPTURES   folder that tools/bench/gpu.py reads
# OUT        gets gpu.json, tests.log and bench.log
#
# PYTHON=python3   an interpreter that has torch with CUDA, of the version that the gsplat wheel was built for
# BUDGET_S=520     seconds in all; each part is stopped at its own limit
set -uo pipefail
cd "$(dirname "$0")/../.."
PYTHON=${PYTHON:-python3}
export PYTHONUNBUFFERED=1
status=0
say() { printf '== %4d s  %s\n' "$SECONDS" "$*"; }

if [ "${1:-}" = --dry-run ]; then
    captures=$2 out=$3
    mkdir -p "$out"
    timeout 900 "$PYTHON" -m pytest -q -p no:cacheprovider tests/render/test_render_gsplat.py 2>&1 | tee "$out/tests.log" | tail -n 3 ||
        status=1
    timeout 1800 "$PYTHON" tools/bench/gpu.py "$captures" --dry-run --json "$out/gpu.json" 2>&1 | tee "$out/bench.log" || status=1
    exit "$status"
fi

wheels=$1 captures=$2 out=$3
shift 3
mkdir -p "$out"
budget=${BUDGET_S:-520}
left() { echo $((budget - SECONDS)); }

# --- what is missing here --------------------------------------------------------------------------------------------
site=${GSMAP_SITE:-/tmp/gsmap-site}
say "installing wheels"
"$PYTHON" -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --upgrade --target "$site" "$wheels"/*.whl || exit 1
export PYTHONPATH=$PWD:$PWD/synthetic:$PWD/tests/render:$site${PYTHONPATH:+:$PYTHONPATH}
export TORCH_CUDA_ARCH_LIST=${TORCH_CUDA_ARCH_LIST:-$("$PYTHON" -c 'import torch; print("%d.%d" % torch.cuda.get_device_capability())')}
export MAX_JOBS=${MAX_JOBS:-$(nproc)}
# Headers of CUDA's libraries, where the toolkit came as wheels.
CPATH=$("$PYTHON" -c 'import glob, sysconfig; print(":".join(glob.glob(sysconfig.get_path("purelib") + "/nvidia/*/include")))')
export CPATH
# A module that was built for this Python elsewhere and carried along is taken as it is.
{ "$PYTHON" -c 'import gsmap._native' 2>/dev/null && touch gsmap/_native*.so || PYTHON="$PYTHON" tools/build_native.sh; } >"$out/build.log" 2>&1 &
native=$!
say "gsplat's kernels"
timeout "$(left)" "$PYTHON" -c 'import gsplat.cuda._backend as b; assert b._C is not None' >>"$out/gsplat.log" 2>&1 ||
    { tail -n 20 "$out/gsplat.log"; exit 1; }
wait "$native" || { tail -n 20 "$out/build.log"; exit 1; }
"$PYTHON" -c 'import torch, gsplat; print(torch.cuda.get_device_name(), torch.__version__, "gsplat", gsplat.__version__)'

# --- tests, then figures ---------------------------------------------------------------------------------------------
say "tests"
timeout "${TESTS_S:-90}" "$PYTHON" -m pytest -q -p no:cacheprovider tests/render/test_render_gsplat.py -k "${TESTS:-cuda}" >"$out/tests.log" 2>&1 || status=1
tail -n "${TESTS_LINES:-25}" "$out/tests.log"
declare -A limit=([kernels]=90 [fit]=60 [merge]=60 [describe]=70 [pairs]=170 [tile]=120 [memory]=60)
for part in "${@:-kernels fit merge describe pairs tile memory}"; do
    for one in $part; do
        [ -n "${limit[$one]:-}" ] || { say "no part is called $one: ${!limit[*]}"; exit 2; }
        seconds=$(left)
        [ "$seconds" -gt 5 ] || { say "$one: not run, the budget is spent"; continue; }
        [ "$seconds" -lt "${limit[$one]}" ] || seconds=${limit[$one]}
        say "$one, at most $seconds s"
        # shellcheck disable=SC2086
        timeout "$seconds" "$PYTHON" tools/bench/gpu.py "$captures" --parts "$one" --json "$out/gpu.json" ${BENCH_OPTIONS:-} 2>&1 | tee -a "$out/bench.log" || status=1
    done
done
say "done"
exit "$status"
