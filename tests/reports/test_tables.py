"""Tables of `specs` without published numbers."""

import math
from dataclasses import replace

import pytest
from omegaconf import OmegaConf
from support.made_up import RULES, budgets, builder, columns, compared, of_experiment, result, run_set, small, value

from padgs.reports.frame import law
from padgs.reports.methods import title
from padgs.reports.significance import BEST, SECOND, emphasis
from padgs.reports.specs import DEVIATIONS, PARTS, RUNGS, WITHOUT
from padgs.reports.table import ReportError, Table
from padgs.reports.writers import markdown
from padgs.results import STOP_REQUESTED, Scores

table1, table4, methods, equal_time = map(builder, ("table1", "table4", "methods", "equal_time"))
ladder, deviations, order, length = map(builder, ("ladder", "deviations", "order", "length"))
learning_rates, modulation, capacity, runs = map(builder, ("learning_rates", "modulation", "capacity", "runs"))
ROOM = "synthetic-room"
BUDGETS = {("omnigs", 20_000): 24.0, ("omnigs", 50_000): 26.0, ("odgs", 20_000): 25.0, ("odgs", 50_000): 25.5}


def ranks(table: Table, block: str = ROOM) -> dict[str, set[str]]:
    """Row of a block -> its places in any column."""
    found = next(b for b in table.blocks if b.title.startswith(block))
    places = [emphasis(found, index, table.columns) for index in range(len(table.columns))]
    return {row.title: {of[number] for of in places if number in of} for number, row in enumerate(found.rows)}


def timed(method: str, seconds: float, iterations: int, psnr: float = 25.0, **others):
    """A run of `equal_time`."""
    budget = {"seconds": float(seconds), "clock": "cpu"}
    config = {"train": {"iterations": 30_000}, "budget": budget, "method": {"sh_degree": 3}, "seed": 0}
    own = {"method": method, "iterations": iterations, "iterations_done": iterations, "config": config}
    made = small(psnr, seconds / 100, experiments=("equal_time",), **own, **others)
    return replace(made, run=f"{made.run}_{iterations}")


def repeated(made):
    return [replace(one, seed=seed, run=f"{one.run}_seed{seed}") for one in made for seed in range(3)]


def stopped(run):
    ended = {"seed": 9, "variant": "stopped after 9 iterations", "ended": STOP_REQUESTED}
    return replace(run, run="stopped", **ended)


def crossed(seeds=(0.0, 0.1)):
    """Runs of `modulation`: the small voxel gains 2 dB, τ costs 2.6 and 0.2 a seed, and both together gain 0.3."""
    return [
        of_experiment(
            "modulation@cpu",
            26 + off + 2.0 * voxel + (-2.6 + seed * 0.2) * tau + 0.3 * voxel * tau,
            preset="padgs" if voxel else "padgs_small",
            options={"tau": 0.9 * tau},
            seed=seed,
        )
        for voxel in (0, 1)
        for tau in (0, 1)
        for seed, off in enumerate(seeds)
    ]


def scaled(best):
    """Runs of `learning_rates`: worse by 1 dB for each doubling away from the best factor of a length."""
    return [
        of_experiment(
            "learning_rates@cpu",
            25 - abs(math.log2(factor / best(n))) + off,
            preset="omnigs",
            iterations=n,
            seed=seed,
            train={"learning_rates": factor if factor > 1 else "published"},
        )
        for factor in (1.0, 2.0, 4.0, 8.0)
        for n in (400, 1600, 6400)
        for seed, off in enumerate((0.0, 0.1))
    ]


LONG = {"omnigs": 27.0, "odgs": 28.0, "spags": 29.0, "op43dgs": 26.0}
SHORT = {"omnigs": 24.0, "odgs": 23.0, "spags": 22.0, "op43dgs": 25.0}  # the reverse
MIDDLE = {"omnigs": 24.0, "odgs": 25.0, "spags": 26.0, "op43dgs": 23.95}


def lengths():
    orders = {("published", 500): SHORT, ("published", 1500): MIDDLE, ("published", 7000): LONG, ("run", 500): MIDDLE}
    return [
        of_experiment("length", psnr + off, preset=preset, iterations=n, seed=seed, train={"learning_rates": rates})
        for (rates, n), order in orders.items()
        for preset, psnr in order.items()
        for seed, off in enumerate((-0.02, 0.02))
    ]


def ordered(experiment="order@cpu", **others):
    quality = {"omnigs": 25.0, "odgs": 25.05, "spags_sorted": 27.0, "op43dgs": 24.0}
    return [
        of_experiment(experiment, psnr + off, preset=preset, seed=seed, **others)
        for preset, psnr in quality.items()
        for seed, off in enumerate((-0.1, 0.0, 0.1))
    ]


def deviating(**psnr: float):
    return [replace(small(v), variant=name, run=name, experiments=("deviations",)) for name, v in psnr.items()]


@pytest.mark.parametrize(
    "table, titles",
    [
        ("ablation", {**PARTS, **RUNGS}),
        ("plus_ablation", WITHOUT),
        ("deviation", {variant: title for titles in DEVIATIONS.values() for variant, title in titles.items()}),
    ],
)
def test_each_variant_that_can_be_run_has_a_row(root, table, titles):
    rows = OmegaConf.load(root / "conf" / "variants" / f"{table}.yaml")
    assert {variant: row.title for variant, row in rows.items()} == titles


@pytest.mark.parametrize(
    ("build", "made"),
    [
        (modulation, crossed()),
        (capacity, budgets(BUDGETS)),
        (learning_rates, scaled(lambda n: 2)),
        (equal_time, [timed("padgs", 100, 900, 25), timed("omnigs", 100, 900, 24)]),
        (order, ordered()),
    ],
)
def test_a_stopped_run_is_no_seed(build, made):
    assert build(run_set([*made, stopped(made[0])])) == build(run_set(made))


@pytest.mark.parametrize("build", [ladder, deviations, order, length, learning_rates, modulation, capacity, equal_time])
def test_without_runs_of_its_experiments_a_table_is_empty(build):
    assert build(run_set([])).blocks == () == build(run_set([of_experiment("tau", 20.0)])).blocks


def test_every_method_with_all_numbers():
    table = methods(run_set(compared(seeds=2)))
    assert [block.title.split()[0] for block in table.blocks] == ["Average", "synthetic-outdoor", ROOM]
    assert {"PSNR", "SSIM", "WS-PSNR", "WS-PSNR pole", "seam", "training s", "ms per frame", "MB"} <= {*columns(table)}
    assert "seam" in [column.heading for column in table.columns], "best at 1: neither end is better"
    assert value(table, ROOM, "OmniGS, corrected", "PSNR") == pytest.approx(22 + 0.8 * 3 + 0.05), "mean of two seeds"
    outdoor = next(b for b in table.blocks if b.title.startswith("synthetic-outdoor"))
    assert next(r for r in outdoor.rows if r.title == "OP43DGS, corrected").cells[0].status == "oom"


def test_a_method_that_saw_far_fewer_pixels_is_shown_and_not_ranked():
    config = {"train": {"iterations": 1500}, "method": {"rays": 1024}, "seed": 0}
    fewer = small(30, 0.1, method="egonerf", preset="egonerf_small", config=config)
    of = run_set(repeated([fewer, small(25), small(24, 2.0, method="omnigs")]))
    table = methods(of)
    assert value(table, ROOM, "EgoNeRF, small", "PSNR") == pytest.approx(30), "the best, at the smallest costs"
    assert value(table, ROOM, "EgoNeRF, small", "images seen") == pytest.approx(1500 * 1024 / (512 * 256))
    assert value(table, ROOM, "PaD-GS", "images seen") == 1500
    assert ranks(table) == {"EgoNeRF, small": set(), "OmniGS, corrected": {SECOND}, "PaD-GS": {BEST}}
    reason = "Not ranked: EgoNeRF, small (12 of 1500 images): for it saw less than half"
    text = markdown(table)
    assert "| EgoNeRF, small † (n=3) |" in text and "| PaD-GS (n=3) |" in text and f"- † {reason}" in text
    for build in (table1, table4):
        assert not ranks(build(of))["EgoNeRF, small"] and any(reason in note for note in build(of).notes)
    slow = timed("egonerf", 100, 1500, 30, preset="egonerf_small")
    slow = replace(slow, config={**slow.config, "method": {"rays": 1024}})
    equal = equal_time(run_set(repeated([timed("padgs", 100, 900), timed("omnigs", 100, 900, 24), slow])))
    assert BEST in ranks(equal)["EgoNeRF, small"] and "Not ranked" not in markdown(equal)


@pytest.mark.parametrize(
    ("method", "knob"),
    [("sc_omnigs", "pose_noise_rotation"), ("sc_omnigs", "pose_noise_translation"), ("seam360gs", "lens_gap")],
)
def test_calibrating_methods_are_ranked_where_there_is_something_to_calibrate(method, knob):
    def ranked(dataset="synthetic", **generator) -> bool:
        own = {"config": {"data": {"generator": {"scene": "room", **generator}}, "seed": 0}, "dataset": dataset}
        table = methods(run_set(repeated([small(20, 1.0, **own), small(30, 0.5, method=method, **own)])))
        (mine,) = {row.title for row in table.blocks[0].rows} - {"PaD-GS"}
        best = bool(ranks(table)[mine])
        assert ("+experiment=calibration compares it where they are" in "".join(table.notes)) == (not best)
        return best

    assert ranked(**{knob: 0.1}) and not ranked(**{knob: 0.0}) and not ranked()
    other = "lens_gap" if method == "sc_omnigs" else "pose_noise_rotation"
    assert not ranked(**{other: 0.1}), "errors that the other method corrects"
    assert not ranked("", **{knob: 0.1}), "photographs ignore the generator's keys"


def test_cameras_of_test_views_are_named_where_some_are_no_panoramas():
    runs = compared([ROOM], seeds=1)
    assert not any("test views" in note for note in table1(run_set(runs)).notes)
    made = [replace(run, cameras={"a": "panorama", "b": "pinhole", "c": "panorama"}) for run in runs]
    assert any("test views: 2 panorama, 1 pinhole, 1500 iterations" in note for note in table1(run_set(made)).notes)


def test_initial_size_and_processor_time_have_columns():
    first, second = small(24, method="omnigs"), small(25)
    counts, timing = {**second.counts, "start": 72_000}, {**second.timing, "cpu_seconds": 57.0}
    table = methods(run_set([first, replace(second, counts=counts, timing=timing)]))
    assert [value(table, ROOM, "PaD-GS", name) for name in ("started from", "training s")] == [72_000, 57]
    assert value(table, ROOM, "OmniGS, corrected", "started from") is None


def test_learning_rates_are_named_and_not_mixed():
    rates = {"train": {"iterations": 1500, "learning_rates": "run"}, "seed": 0}
    scaled, published = small(25, config=rates), small(24, method="omnigs")
    assert any("learning rates run, seeds" in note for note in methods(run_set([scaled])).notes)
    assert any("learning rates published, seeds" in note for note in methods(run_set([published])).notes)
    with pytest.raises(ReportError, match="differ in learning_rates"):
        methods(run_set([scaled, published]))


def test_each_time_has_a_block():
    short = [timed("padgs", 20, 250, 20), timed("omnigs", 20, 300, 21)]
    long = [timed("padgs", 60, 700, 26), timed("omnigs", 60, 900, 27)]
    table = equal_time(run_set([*short, *long]))
    place = f"{ROOM} (generated, tuned on)"
    assert [block.title for block in table.blocks] == [f"{place}, 512x256, {s} s of CPU time" for s in (20, 60)]
    for block, *expected in ((f"{place}, 512x256, 20", 250, 20), (f"{place}, 512x256, 60", 700, 26)):
        assert [value(table, block, "PaD-GS", name) for name in ("iterations", "PSNR")] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("build", "made", "what"),
    [
        (methods, [small(25), small(26, method="omnigs", iterations=3000)], "length"),
        (methods, [small(25), small(26, method="omnigs", machine={"gpu": "H200"})], "machine"),
        (equal_time, [timed("padgs", 9, 90), timed("omnigs", 9, 90, machine={"gpu": "H200"})], "machine"),
        (
            deviations,
            [replace(r, iterations=1500 + i) for i, r in enumerate(deviating(padgs=25, padgs_all=24))],
            "length",
        ),
        (
            ladder,
            [
                replace(small(25), variant="a0_pano_3dgs"),
                replace(small(25), variant="a1_anchors", machine={"gpu": "H200"}),
            ],
            "machine",
        ),
    ],
)
def test_runs_under_different_conditions_do_not_stand_together(build, made, what):
    with pytest.raises(ReportError, match=f"differ in {what}"):
        build(run_set(made))
    assert build(run_set(made, mix=True)).blocks


def test_a_scene_of_two_data_sets_has_a_block_for_each():
    made = [timed("padgs", 100, 900, scene="classroom", dataset=dataset) for dataset in ("", "omniblender")]
    for build in (methods, equal_time):
        capture, rendered = (block.title for block in build(run_set(made)).blocks[-2:])
        assert capture.startswith("classroom") and "(" not in capture
        assert rendered.startswith("classroom (omniblender)")


def test_seeds_may_differ_in_iterations_after_equal_time_but_in_no_setting():
    made = [timed("padgs", 100, 900, 25), timed("padgs", 100, 950, 27, seed=1)]
    assert value(equal_time(run_set(made)), ROOM, "PaD-GS", "PSNR") == pytest.approx(26)
    other = replace(made[1], config={**made[1].config, "method": {"sh_degree": 0}})
    with pytest.raises(ReportError, match="differ in method.sh_degree"):
        equal_time(run_set([made[0], other]))


def test_a_rung_has_a_row_with_its_costs():
    rungs = [replace(small(24 + i, 1 + i), variant=variant) for i, variant in enumerate(RUNGS)]
    text = markdown(ladder(run_set([*rungs[:3], result("full")])))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| A")]
    assert [row[0][:2] for row in rows] == [f"A{i}" for i in range(7)]
    assert [row[2] for row in rows] == ["24.00", "25.00", "26.00", "–", "–", "–", "–"]
    assert [row[4] for row in rows][:3] == ["50000", "100000", "150000"]


def test_each_deviation_beside_the_method_as_described():
    table = deviations(run_set(deviating(padgs=25.0, padgs_distance=24.25, padgs_all=22.0)))
    (block,) = table.blocks
    assert block.title.startswith("PaD-GS, synthetic-room")
    changes = {row.title: row.cells[columns(table).index("Δ")].value for row in block.rows}
    assert changes["as described"] == 0 and changes["distance in world units"] == pytest.approx(-0.75)
    assert changes["as released"] == pytest.approx(-3) and changes["limit on scales"] is None


def test_a_difference_is_of_the_seeds_that_both_rows_have():
    psnr = {"padgs": (30.0, 30.0, 20.0), "padgs_distance": (29.0, 29.0)}
    made = [(name, seed, quality) for name, of in psnr.items() for seed, quality in enumerate(of)]
    made = [
        replace(small(v, seed=s), variant=name, run=f"{name}{s}", experiments=("deviations",)) for name, s, v in made
    ]
    lost = replace(made[-1], run="lost", seed=2, status="nan", scores={}, config={**made[-1].config, "seed": 2})
    table = deviations(run_set([*made, lost]))
    assert value(table, "PaD-GS", "distance in world units", "Δ") == pytest.approx(-1.0)


def test_a_difference_from_runs_that_all_failed_is_missing():
    made = [replace(one, status="oom", scores={}) for one in deviating(padgs=25.0, padgs_distance=24.0)]
    table = deviations(run_set(made))
    assert value(table, "PaD-GS", "distance in world units", "Δ") is None


def test_a_method_that_failed_on_a_seed_has_no_rank_beside_others():
    lost = of_experiment("order@cpu", 30.0, preset="omnigs", seed=3)
    made = [*ordered(), replace(lost, status="oom", scores={})]
    (block,) = order(run_set(made)).blocks
    assert {row.cells[0].value for row in block.rows} == {None}


def test_the_best_stands_first_by_a_metric_that_falls():
    (block,) = order(run_set(ordered(), metrics=("lpips_vgg_01",))).blocks
    assert [row.cells[0].value for row in block.rows] == [1, 2, 2, 4]


def test_ranks_are_of_the_metric_that_is_shown():
    table = order(run_set(ordered(), metrics=("lpips_vgg_01",)))
    assert any(note.startswith("Rank: ") and "by LPIPS" in note for note in table.notes)
    count = order(run_set(ordered(), metrics=("gaussians",)))
    assert columns(count) == ["Gaussians"] and not any(note.startswith("Rank: ") for note in count.notes)


def test_a_metric_without_a_protocol_is_of_the_one_asked_for():
    table = modulation(run_set(crossed(), protocol="sphere", metrics=("psnr",)))
    assert columns(table) == ["PSNR"]


def test_rows_that_seeds_cannot_separate_share_a_rank_and_the_best_stands_first():
    (block,) = order(run_set(ordered())).blocks
    expected = {"spags_sorted": 1, "odgs": 2, "omnigs": 2, "op43dgs": 4}  # in the order of the means
    assert [(row.title, row.cells[0].value) for row in block.rows] == [(title(of), n) for of, n in expected.items()]


def test_settings_of_one_method_are_rows_and_a_failed_one_has_no_rank():
    made = [of_experiment("order", 25 + tau, options={"tau": tau}, seed=s) for tau in (0.0, 0.9) for s in range(3)]
    broken = replace(of_experiment("order", 30, preset="odgs"), status="oom", scores={})
    (block,) = order(run_set([broken, *made])).blocks
    found = {row.title: row.cells[0].value for row in block.rows}
    assert found == {"PaD-GS, tau 0.9": 1, "PaD-GS, tau 0.0": 2, title("odgs"): None}


def test_each_experiment_scene_size_and_length_has_a_block():
    made = [*ordered(), *ordered("photographs"), *ordered(scene="atrium"), *ordered(iterations=7000), *ordered("tau")]
    titles = [block.title for block in order(run_set(made)).blocks]
    starts = ["order: atrium", f"order: {ROOM}", f"order: {ROOM}", f"photographs: {ROOM}"]
    assert [title.partition(" (")[0] for title in titles] == starts
    assert [title.rpartition(", ")[2] for title in titles[1:3]] == ["1500 iterations", "7000 iterations"]


def test_lengths_and_rates_are_columns():
    table = length(run_set(lengths()))
    titles = columns(table)
    assert titles[0] == "500 iterations, published rates" and titles[3] == "500 iterations, rates for the run"
    assert value(table, ROOM, title("odgs"), titles[0]) == pytest.approx(22.6)


@pytest.mark.parametrize(
    ("best", "losses"),
    [
        (lambda n: min((1, 2, 4, 8), key=lambda f: abs(math.log(f / law(n, "omnigs")))), (0, 0, 0)),
        (lambda n: 2, (-2, 0, -1)),
    ],
)
def test_the_law_loses_the_distance_of_its_factor_from_the_best(best, losses):
    table = learning_rates(run_set(scaled(best)))
    factors, lost = table.blocks
    assert [row.title for row in factors.rows] == ["× 1", "× 2", "× 4", "× 8"]
    assert factors.rows[1].cells[0].value == pytest.approx(25 - abs(math.log2(2 / best(400))) - 0.35)
    assert [cell.value for cell in lost.rows[0].cells] == pytest.approx(losses)
    assert [cell.std for cell in lost.rows[0].cells] == pytest.approx([0, 0, 0]), "seed by seed"
    assert "× 8.00 after 400, × 4.33 after 1600, × 2.17 after 6400 iterations" in "".join(table.notes)


def test_a_run_that_failed_before_its_first_iteration_has_no_length():
    made = scaled(lambda n: 2)
    rates = {"train": {"learning_rates": "run"}}
    early = replace(made[0], run="failed", iterations=0, status="oom", scores={}, config=rates)
    assert learning_rates(run_set([*made, early])) == learning_rates(run_set(made))


def test_voxels_are_crossed_with_modulation_and_the_paper_may_score_without_the_bottom():
    rules = RULES | {"bottom_crop": 0.0635}
    made = [replace(run, scores={**run.scores, "paper": Scores(rules, {"psnr": 30.0}, {})}) for run in crossed()]
    table = modulation(run_set(made))
    assert value(table, ROOM, "one anchor per 3 px, τ = 0", "WS-PSNR") == pytest.approx(25.65)
    assert value(table, ROOM, "one anchor per 0.1 px, τ = 0.9", "PSNR by the paper's protocol") == 30
    assert value(table, ROOM, "one anchor per 0.1 px, τ = 0.9", "PSNR") != 30
    assert "without the last 6.3 % of the rows" in "".join(table.notes)


def test_each_number_of_gaussians_has_a_block_the_fewest_first():
    odd = of_experiment("capacity", 30.0)
    odd = [replace(odd, run=f"{n}", config={**odd.config, "budget": {"gaussians": n}}) for n in ("auto", None)]
    table = capacity(run_set([*budgets(BUDGETS), *odd]))
    for block, count, expected in zip(table.blocks, (20_000, 50_000), ((25.05, 24.05), (25.55, 26.05)), strict=True):
        assert block.title.endswith(f"at most {count // 1000} 000 Gaussians")
        cells = [[row.cells[columns(table).index(name)].value for row in block.rows] for name in ("PSNR", "Gaussians")]
        assert cells[0] == pytest.approx(expected) and cells[1] == [count - 0.5] * 2
