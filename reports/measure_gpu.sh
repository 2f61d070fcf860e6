#!/bin/sh
# Build, benchmark, test and sanitize on a machine with an NVIDIA GPU. Each step updates reports/measured/<device>.json;
# the last line of output names the verified and the missing steps.
#
#   reports/measure_gpu.sh [STEP...]     default: build bench kernels tests memcheck synccheck racecheck initcheck
#
# Finished steps are skipped, so the same command resumes after an interruption. build/gpu/out/STEP.state has the status
# of a step, STEP.log its output. Delete build/gpu/out to start over.
#
# Needs nvcc, cmake, a C++ compiler, and python3 (or PYTHON) with torch, numpy, scipy, pytest, hypothesis, typer and rich,
# but no network: missing pure-Python packages may be wheels in the folder wheels/. FULL=0 skips a million Gaussians.
# LIMIT is the time limit of a step in seconds (default: 540).
set -eu
cd "$(dirname "$0")/.."
self=$PWD/reports/$(basename "$0")
python=${PYTHON:-python3}
build=$PWD/build/gpu
out=$build/out
site=$build/site
all="build bench kernels tests memcheck synccheck racecheck initcheck"
mkdir -p "$site" "$out" reports/measured
export PADGS_LIBRARY_DIR="$build/lib" PYTHONPATH="$PWD:$site" PYTHONUNBUFFERED=1 OMP_NUM_THREADS=4

build() {
  if [ -d wheels ]; then $python -m pip install -q --no-index --no-deps --upgrade --target "$site" wheels/*.whl; fi
  if [ -d baselines ]; then ln -sfn ../baselines padgs/baselines && ln -sfn ../reports padgs/reports; fi # not installed
  cmake -S . -B "$build" -DCMAKE_BUILD_TYPE=Release -DPADGS_CUDA=ON
  cmake --build "$build" --parallel
  mkdir -p "$build/lib"
  find "$build/padgs" -name 'libpadgs_*.so' -exec cp {} "$build/lib" \;
}
bench() {
  full=--full
  if [ "${FULL:-1}" = 0 ]; then full=--no-full; fi
  $python -c 'from padgs.cli.app import main; main()' bench --device cuda $full --out "$out"
}
kernels() { $python -m pytest -q -m cuda tests/render/cuda --junitxml="$out/kernels.xml"; }
tests() { $python -m pytest -q -m cuda tests/render --ignore=tests/render/cuda --junitxml="$out/tests.xml"; }
# The files at the same time, since a sanitizer keeps only one core busy.
sanitizer() {
  printf '%s\n' backend decoder loss splats | xargs -P 4 -I FILE compute-sanitizer --tool "$1" --error-exitcode 99 \
    $python -m pytest -q -x -m cuda -k "not long and not any_size" tests/render/cuda/test_cuda_FILE.py
}
# Without torch's caching allocator, whose large blocks count as initialized.
memcheck() { PYTORCH_NO_CUDA_MEMORY_CACHING=1 sanitizer memcheck; }
synccheck() { sanitizer synccheck; }
racecheck() { sanitizer racecheck; }
initcheck() { PYTORCH_NO_CUDA_MEMORY_CACHING=1 sanitizer initcheck; }

conclude() {
  $python - "$out" $all <<'END'
import json, re, sys
from pathlib import Path
from xml.etree import ElementTree

out, steps = Path(sys.argv[1]), sys.argv[2:]
states = {step: (out / f"{step}.state").read_text().strip() if (out / f"{step}.state").exists() else "not run" for step in steps}
if (out / "bench.json").exists():
    report = json.loads((out / "bench.json").read_text()) | {"steps": states}
    for step in ("kernels", "tests"):
        if not (out / f"{step}.xml").exists():
            continue
        suite = ElementTree.parse(out / f"{step}.xml").getroot().find("testsuite")
        counts = {key: int(suite.get(key)) for key in ("tests", "failures", "errors", "skipped")}
        cases = [case for case in suite.iter("testcase") if case.find("failure") is not None]
        report[step] = {**counts, "failed": [f"{case.get('classname')}::{case.get('name')}" for case in cases]}
    name = re.sub(r"[^a-z0-9]+", "-", report["machine"]["gpu"].lower()).strip("-")
    Path("reports/measured", f"{name}.json").write_text(json.dumps(report, indent=1) + "\n")
verified = " ".join(step for step, state in states.items() if state == "ok")
missing = ", ".join(f"{step} ({state})" for step, state in states.items() if state != "ok")
print(f"verified: {verified or 'nothing'}; not verified: {missing or 'nothing'}")
END
}

# One step in a process of its own, for the time limit.
if [ "${1:-}" = --only ]; then
  "$2"
  exit
fi
for step in ${*:-$all}; do
  case " $all " in *" $step "*) ;; *) echo "unknown step $step; known: $all" >&2; exit 2 ;; esac
  if [ "$(cat "$out/$step.state" 2>/dev/null)" = ok ]; then continue; fi
  echo "$step ..."
  if timeout "${LIMIT:-540}" "$self" --only "$step" >"$out/$step.log" 2>&1; then
    echo ok >"$out/$step.state"
  else
    echo "failed ($?)" >"$out/$step.state"
    tail -n 5 "$out/$step.log"
  fi
  conclude >"$out/verdict"
  if [ "$step" = build ] && [ "$(cat "$out/build.state")" != ok ]; then break; fi
done
cat "$out/verdict"
