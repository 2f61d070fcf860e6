from dataclasses import replace

from made_up import builder, of_experiment, run_set

from padgs.reports.methods import title

order = builder("order")

QUALITY = {"omnigs": 25.0, "odgs": 25.05, "spags_sorted": 27.0, "op43dgs": 24.0}


def runs(experiment="order@cpu", seeds=(-0.1, 0.0, 0.1), **others):
    return [
        of_experiment(experiment, psnr + off, preset=preset, seed=seed, **others)
        for preset, psnr in QUALITY.items()
        for seed, off in enumerate(seeds)
    ]


def ranks(table) -> list[dict[str, float | None]]:
    return [{row.title: row.cells[0].value for row in block.rows} for block in table.blocks]


def test_what_seeds_cannot_separate_shares_a_rank_and_the_best_stands_first():
    table = order(run_set(runs()))
    (found,) = ranks(table)
    expected = {"spags_sorted": 1, "odgs": 2, "omnigs": 2, "op43dgs": 4}  # in the order of the means
    assert list(found.items()) == [(title(preset), rank) for preset, rank in expected.items()]


def test_settings_of_one_method_are_rows_and_what_failed_has_no_rank():
    made = [of_experiment("order", 25 + tau, options={"tau": tau}, seed=s) for tau in (0.0, 0.9) for s in (0, 1)]
    broken = replace(of_experiment("order", 30, preset="odgs"), status="oom", scores={})
    (found,) = ranks(order(run_set([broken, *made])))
    assert found == {"PaD-GS, tau 0.9": 1, "PaD-GS, tau 0.0": 2, title("odgs"): None}


def test_each_experiment_scene_size_and_length_has_a_block_of_its_own():
    made = [*runs(), *runs("photographs"), *runs("order", scene="flat"), *runs("order", iterations=7000), *runs("tau")]
    titles = [block.title for block in order(run_set(made)).blocks]
    assert [title.partition(" (")[0] for title in titles] == [
        "order: flat",
        "order: synthetic-room",
        "order: synthetic-room",
        "photographs: synthetic-room",
    ]
    assert [title.rpartition(", ")[2] for title in titles[1:3]] == ["1500 iterations", "7000 iterations"]
    assert order(run_set(runs("tau"))).blocks == ()
