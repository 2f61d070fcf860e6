"""Whether two checkouts train to the same numbers: one short run of each method, compared bit by bit.

    python tests/support/compare_checkouts.py OLD NEW FOLDER

OLD and NEW are checkouts whose `.venv` is set up (`make test` does that), FOLDER takes the runs of both; finished ones
are not repeated. Compared are the tensors and values of the checkpoint, the scores and the name of the run; then NEW
has to open every folder of OLD and find nothing to do. Times and memory may differ. Exit code 1 if anything else does.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

SETTINGS = [
    "data.generator.width=64",
    "data.generator.train_views=6",
    "data.generator.test_views=2",
    "data.generator.points=1500",
    "data.generator.samples=4",
    "train.iterations=120",
    "protocol.paper.lpips=alex",
    "protocol.sphere.lpips=alex",
    "run.device=cpu",
    "tracking=none",
]
# Where the defaults take too long for this.
MORE = {"egonerf": ["method.rays=64", "train.iterations=3"], "egonerf_small": ["method.rays=64", "train.iterations=8"]}
NOT_COMPARED = ("seconds",)  # keys of what a checkpoint and a log hold


def train(checkout: Path, method: str, runs: Path) -> subprocess.CompletedProcess:
    """`padgs-run` of a checkout, from the checkout, so that its own files are found."""
    settings = {setting.partition("=")[0]: setting for setting in (*SETTINGS, *MORE.get(method, []))}
    command = [checkout / ".venv/bin/padgs-run", f"method={method}", *settings.values(), f"run.folder={runs}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(list(map(str, command)), cwd=checkout, env=environment, capture_output=True, text=True)


def numbers(run: Path) -> dict[str, object]:
    """All that may not differ between two runs, flat: name -> value."""
    from safetensors.numpy import load_file

    state = json.loads((run / "checkpoint/state.json").read_bytes())
    tensors = load_file(run / "checkpoint" / state["tensors"])
    result = json.loads((run / "result.json").read_bytes())
    found: dict[str, object] = {f"tensor {name}": (str(t.dtype), t.shape, t.tobytes()) for name, t in tensors.items()}
    found |= {f"state {name}": value for name, value in flat(state["values"])}
    found |= {f"score {name}": value for name, value in flat(result["scores"])}
    for name in ("status", "counts", "model_bytes", "config_hash", "fingerprint", "iterations_done", "run"):
        found[name] = json.dumps(result[name], sort_keys=True)
    for line in map(json.loads, (run / "log.jsonl").read_text().splitlines()):
        found |= {f"log {line['iteration']} {name}": value for name, value in flat(line)}
    return {name: value for name, value in found.items() if not name.endswith(NOT_COMPARED)}


def flat(values: dict, where: str = "") -> list[tuple[str, object]]:
    """Names with dots, and values."""
    pairs = []
    for key, value in values.items():
        pairs += flat(value, f"{where}{key}.") if isinstance(value, dict) else [(f"{where}{key}", value)]
    return pairs


def differences(old: Path, new: Path) -> list[str]:
    """Names of what differs between two folders of one run each."""
    (mine,), (theirs,) = (sorted(path.parent for path in runs.glob("*/result.json")) for runs in (old, new))
    before, after = numbers(mine), numbers(theirs)
    return [name for name in sorted(before.keys() | after.keys()) if before.get(name) != after.get(name)]


def main(old: Path, new: Path, folder: Path) -> int:
    """Print a line for each method; the exit code."""
    names = [old / ".venv/bin/python", "-c", "from padgs.baselines import METHODS; print(*METHODS)"]
    own = subprocess.run(list(map(str, names)), cwd=old, capture_output=True, text=True, check=True).stdout.split()
    methods, wrong = {*own, *(path.stem for path in (old / "conf/method").glob("*.yaml"))}, 0
    for method in sorted(methods):
        runs = [folder / "old" / method, folder / "new" / method]
        for checkout, place in zip((old, new), runs, strict=True):
            done = train(checkout, method, place)
            if done.returncode:
                print(f"{method}: padgs-run of {checkout} failed\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
        found = differences(*runs) if all(list(place.glob("*/result.json")) for place in runs) else ["no result"]
        again = train(new, method, runs[0])
        if "nothing to do" not in again.stdout:
            found.append(f"the old folder is not opened: {again.stdout[-500:]}{again.stderr[-500:]}")
        print(f"{method}: {'the same' if not found else 'DIFFERS in ' + ', '.join(found[:8])}", flush=True)
        wrong += bool(found)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(*(Path(argument).resolve() for argument in sys.argv[1:4])))
