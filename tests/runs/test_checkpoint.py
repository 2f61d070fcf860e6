import json
import math
import resource
import signal

import pytest
import torch

from padgs.runs import checkpoint
from padgs.runs.checkpoint import CheckpointError
from padgs.training.model import State


def example(seed: int = 0) -> State:
    generator = torch.Generator().manual_seed(seed)
    tensors = {
        "weights": torch.randn(5, 3, generator=generator),
        "transposed": torch.randn(4, 2, generator=generator).T,
        "step": torch.tensor(7.0),
        "empty": torch.zeros(0, 3),
        "counts": torch.arange(6),
        "flags": torch.tensor([True, False]),
        "generator": generator.get_state(),
    }
    return State(tensors, {"iteration": 7, "seconds": 0.1 + 0.2, "names": ["a", "b"], "nested": {"x": None}})


def assert_same(a: State, b: State) -> None:
    assert a.values == b.values
    assert a.tensors.keys() == b.tensors.keys()
    for name, tensor in a.tensors.items():
        assert tensor.dtype == b.tensors[name].dtype and torch.equal(tensor, b.tensors[name]), name


def tensors_file(folder):
    (file,) = folder.glob("tensors-*")
    return file


def test_round_trip_is_exact(tmp_path):
    checkpoint.save(example(), tmp_path / "checkpoint")
    assert_same(checkpoint.load(tmp_path / "checkpoint"), example())


def test_a_restored_generator_goes_on_where_it_was(tmp_path):
    generator = torch.Generator().manual_seed(3)
    torch.rand(5, generator=generator)
    checkpoint.save(State({"generator": generator.get_state()}, {}), tmp_path)
    restored = torch.Generator()
    restored.set_state(checkpoint.load(tmp_path).tensors["generator"])
    assert torch.equal(torch.rand(9, generator=restored), torch.rand(9, generator=generator))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda file: file.write_bytes(file.read_bytes()[:-1]),
            r"has \d+ bytes instead of .*delete the",
        ),
        (lambda file: file.write_bytes(file.read_bytes()[:-1] + b"\xff"), "SHA-256 differs"),
        (lambda file: file.unlink(), "cannot read .*tensors-"),
    ],
)
def test_damaged_or_missing_tensors_are_refused_by_name(tmp_path, spoil, message):
    checkpoint.save(example(), tmp_path)
    spoil(tensors_file(tmp_path))
    with pytest.raises(CheckpointError, match=message):
        checkpoint.load(tmp_path)


def test_saving_again_replaces_and_leaves_nothing_behind(tmp_path):
    checkpoint.save(example(0), tmp_path)
    checkpoint.save(example(1), tmp_path)
    assert_same(checkpoint.load(tmp_path), example(1))
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    "text",
    [
        *(
            '{"format": 1, "tens',
            "[]",
            "{}",
            '{"format": 1}',
            '{"format": 99}',
            '{"format": []}',
            "null",
            "[" * 100_000,
        ),
        '{"format": 1, "tensors": 3, "bytes": 1, "sha256": "", "values": {}}',
        '{"format": 1, "tensors": "../x", "bytes": 1, "sha256": "", "values": {}}',
        '{"format": 1, "tensors": "x", "bytes": "1", "sha256": "", "values": []}',
    ],
)
def test_damaged_manifest_is_refused(tmp_path, text):
    checkpoint.save(example(), tmp_path)
    (tmp_path / "state.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"state\.json"):
        checkpoint.load(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda manifest: manifest["values"].update(iteration=6),
        lambda manifest: manifest["values"].update(iteration=-7),
        lambda manifest: manifest["values"]["nested"].update(x=1),
        lambda manifest: manifest["run"].update(configuration="b"),
        lambda manifest: manifest.update(more=1),
    ],
)
def test_an_edited_manifest_is_refused(tmp_path, change):
    checkpoint.save(example(), tmp_path, {"configuration": "a"})
    manifest = json.loads((tmp_path / "state.json").read_text())
    change(manifest)
    (tmp_path / "state.json").write_text(json.dumps(manifest))
    with pytest.raises(CheckpointError, match=r"state\.json was changed after it was written .* delete the folder"):
        checkpoint.load(tmp_path)


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    run = {"configuration": "a", "data set": "b"}
    checkpoint.save(example(), tmp_path, run)
    assert_same(checkpoint.load(tmp_path, run=run), example())
    for what in run:
        with pytest.raises(CheckpointError, match=f"is of a run with another {what}; .* delete the folder of the run"):
            checkpoint.load(tmp_path, run={**run, what: "c"})


def test_full_disk_leaves_the_previous_checkpoint_whole(tmp_path):
    """A limit on the size of files makes `write` fail as a full disk does, after part of the file is written."""
    checkpoint.save(example(), tmp_path)
    before = {file.name for file in tmp_path.iterdir()}
    large = State({"weights": torch.zeros(100_000)}, {})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(CheckpointError, match="previous one, if any, is complete"):
            checkpoint.save(large, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert {file.name for file in tmp_path.iterdir()} == before
    assert_same(checkpoint.load(tmp_path), example())


def test_kill_between_the_two_files_keeps_the_old_checkpoint(tmp_path, monkeypatch):
    checkpoint.save(example(0), tmp_path)
    write = checkpoint.write_atomically

    def killed_before_manifest(path, content):
        if path.name == "state.json":
            raise KeyboardInterrupt
        write(path, content)

    monkeypatch.setattr(checkpoint, "write_atomically", killed_before_manifest)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.save(example(1), tmp_path)
    assert_same(checkpoint.load(tmp_path), example(0))
    monkeypatch.undo()
    checkpoint.save(example(2), tmp_path)
    assert len(list(tmp_path.iterdir())) == 2, "the orphan of the killed save is cleared by the next one"


def test_values_that_json_cannot_hold_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        checkpoint.save(State({}, {"loss": math.nan}), tmp_path)
    assert list(tmp_path.iterdir()) == []
