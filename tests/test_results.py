import errno
import json
import math
import os
from dataclasses import replace

import pytest

from padgs import results
from padgs.results import Result, ResultError, Scores


@pytest.fixture
def result() -> Result:
    scores = Scores(
        protocol={"name": "sphere", "metrics": ["psnr", "ssim"]},
        metrics={"psnr": 24.25, "ssim": 0.5, "lpips": None},
        views={"a": {"psnr": math.inf, "ssim": 1.0}, "b": {"psnr": 24.25, "ssim": 0.0}},
        notes=("lpips is missing: no weights",),
    )
    return Result(
        run="padgs-room-0123456789",
        status="ok",
        method="padgs",
        preset="padgs",
        variant="full",
        dataset="synthetic",
        scene="room",
        width=512,
        height=256,
        iterations=1500,
        iterations_done=1500,
        seed=0,
        code_version="0.1.0",
        machine={"cores": 2},
        config_hash="ab",
        fingerprint="cd",
        finished="2026-11-21T00:00:00+00:00",
        scores={"sphere": scores},
        timing={"train_seconds": 0.1},
        counts={"anchors": 3},
        config={"method": {"tau": 0.9, "sizes": [1, 2]}},
    )


def test_what_is_written_is_read_again(result, tmp_path):
    path = results.write(result, tmp_path)
    assert results.read(path) == result
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_what_was_measured_may_be_beyond_the_limits_of_settings(result, tmp_path):
    slow = replace(result, timing={"render_ms_min": 2e6, "train_seconds": 1e9}, counts={"gaussians": 0})
    assert results.read(results.write(slow, tmp_path)) == slow


def test_the_file_is_standard_json(result, tmp_path):
    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    text = results.write(result, tmp_path).read_text()
    assert json.loads(text, parse_constant=refuse)["scores"]["sphere"]["views"]["a"]["psnr"] == "inf"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        *((lambda text, end=end: text[:end], "(JSON|no schema)") for end in (0, 1, 100, -2)),
        (lambda text: text.replace("24.25", "34.25"), "was edited after it was written"),
        (lambda text: text.replace("24.25", "NaN"), "NaN is no number of a result"),
        (lambda text: text.replace('"schema": 2', '"schema": 1'), "was written by another version.* delete it and run"),
        (lambda text: text.replace('"schema": 2', '"schema": 3'), "another version .*; read it with a newer padgs$"),
        (lambda text: text.replace('"seed"', '"colour"'), "unknown key colour; known: .*seed"),
        (lambda text: "[" * 100_000, "is not JSON"),
    ],
)
def test_a_damaged_file_is_named(result, tmp_path, spoil, message):
    path = results.write(result, tmp_path)
    path.write_text(spoil(path.read_text()))
    with pytest.raises(ResultError, match=rf"result.json.*{message}"):
        results.read(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"run": "../x"}, "'../x' is no name that this program gives"),
        ({"preset": "x y"}, "'x y' is no name"),
        ({"dataset": "/etc"}, "'/etc' is no name"),
        ({"experiments": ("tau@cpu", "../../x")}, "'../../x' is no name"),
        ({"experiments": (1,)}, r"experiments\[0\] is 1; it must be a text"),
        ({"experiments": 1}, "experiments is 1; it must be a list"),
        ({"timing": 5}, "timing is 5; it must be a group of keys"),
        ({"scores": {"paper": 3}}, "scores do not have the form"),
        ({"scores": {"paper": {"metrics": {}}}}, "scores do not have the form"),
        ({"seed": "0"}, "seed is '0'; it must be a whole number"),
        ({"config": []}, "config is ..; it must be a group of keys"),
        ({"iterations": True}, "iterations is True"),
        ({"timing": {"train_seconds": 10**400}}, "no number of a result"),
        ({"timing": {"train_seconds": -1.0}}, "timing.train_seconds is -1.0; it must be from 0"),
        ({"iterations_done": -5}, "iterations_done is -5; it must be from 0"),
        ({"reason": "\ud800"}, "surrogates not allowed"),
        ({"counts": {"gaussians": "many"}}, "counts.gaussians is 'many'"),
        ({"config": {"train": []}}, r"config.train is \[\]; it must be a group"),
        ({"config": {"budget": {"seconds": "long"}}}, "could not convert"),
        (
            {"config": {"budget": {"clock": "cpu; rm -rf ."}}},
            "config.budget.clock is 'cpu; rm -rf .'; it must be a name",
        ),
        ({"config": {"budget": {"clock": ["cpu"]}}}, "config.budget.clock is .'cpu'."),
        ({"config": {"protocol": {"sphere": "sphere"}}}, "rules of a protocol are 'sphere'"),
    ],
)
def test_files_from_elsewhere_hold_names_and_numbers_where_they_should(result, tmp_path, change, message):
    """A digest is no signature: whoever sends a file can make it fit."""
    with pytest.raises(ResultError, match=rf"result.json: .*({message})"):
        results.read(results.write(replace(result, **change), tmp_path))


def test_unknown_status_lists_the_known(result):
    with pytest.raises(ValueError, match="unknown status 'fine'; known: ok, oom, nan"):
        replace(result, status="fine")


def test_a_full_disk_leaves_the_old_file_and_no_litter(result, tmp_path, monkeypatch):
    path = results.write(result, tmp_path)

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        results.write(replace(result, seed=1), tmp_path)
    assert results.read(path) == result
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_lines_of_a_log_that_are_being_written_are_left_for_later(tmp_path):
    assert list(results.log_lines(tmp_path)) == []
    (tmp_path / "log.jsonl").write_text('{"iteration": 1}\n{"loss": 2}\n[3]\n{"iteration": 2, "lo')
    assert list(results.log_lines(tmp_path)) == [{"iteration": 1}]


def test_keys_that_decide_nothing_are_left_out_wherever_they_are():
    config = {"data": {"path": "/x", "width": 8, "generator": {"path": 1}}, "protocol": {}, "seed": 1}
    assert results.decisive(config) == {"data": {"width": 8, "generator": {"path": 1}}, "seed": 1}
