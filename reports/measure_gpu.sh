#!/bin/sh
# On a machine with an NVIDIA GPU: build, test, benchmark, and write reports/measured/<device>.json. Needs no network:
# nvcc, cmake, a C++ compiler, and a python3 with torch, numpy, pytest, hypothesis, typer and rich. What is missing of the
# pure-Python ones may lie in the folder wheels/ as wheels. PYTHON names another python3; FULL=0 leaves out a million
# Gaussians. Fails if the build fails; failing tests are counted in the result instead.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
build=$PWD/build/gpu
site=$build/site
mkdir -p "$site" reports/measured
if [ -d wheels ]; then $python -m pip install -q --no-index --no-deps --upgrade --target "$site" wheels/*.whl; fi

capability=$(nvidia-smi --query-gpu=compute_cap --format=csv,noheader | head -n 1 | tr -d .)
cmake -S . -B "$build" -DCMAKE_BUILD_TYPE=Release -DPADGS_CUDA=ON -DPADGS_CUDA_ARCHITECTURES="$capability"
cmake --build "$build" --parallel
mkdir -p "$build/lib"
find "$build/padgs" -name 'libpadgs_*.so' -exec cp {} "$build/lib" \;
export PADGS_LIBRARY_DIR="$build/lib" PYTHONPATH="$PWD:$site" PYTHONUNBUFFERED=1 OMP_NUM_THREADS=4

$python -m pytest -q -m cuda tests/render --junitxml="$build/tests.xml" || echo "some tests failed"
sanitizer=not-run
if command -v compute-sanitizer >/dev/null; then
  if timeout 300 compute-sanitizer --tool memcheck --error-exitcode 99 \
    $python -m pytest -q -x -m cuda tests/render/cuda/test_cuda_backend.py tests/render/cuda/test_cuda_loss.py >"$build/sanitizer.log" 2>&1
  then sanitizer=passed; else sanitizer="failed ($?)"; fi
  tail -n 3 "$build/sanitizer.log"
fi
full=--full
if [ "${FULL:-1}" = 0 ]; then full=--no-full; fi
$python -c 'from padgs.cli.app import app; app()' bench --device cuda $full --out "$build/bench"

SANITIZER="$sanitizer" $python - "$build" <<'END'
import json, os, re, sys
from pathlib import Path
from xml.etree import ElementTree

build = Path(sys.argv[1])
report = json.loads((build / "bench" / "bench_gpu.json").read_text())
suite = ElementTree.parse(build / "tests.xml").getroot().find("testsuite")
counts = {key: int(suite.get(key)) for key in ("tests", "failures", "errors", "skipped")}
failed = [f"{c.get('classname')}::{c.get('name')}" for c in suite.iter("testcase") if c.find("failure") is not None]
report["tests"] = {**counts, "failed": failed}
report["compute_sanitizer"] = os.environ["SANITIZER"]
name = re.sub(r"[^a-z0-9]+", "-", report["machine"]["gpu"].lower()).strip("-")
target = Path("reports/measured") / f"{name}.json"
target.write_text(json.dumps(report, indent=1) + "\n")
print(f"written: {target}; tests: {counts}")
END
