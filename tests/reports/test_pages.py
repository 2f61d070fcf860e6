"""Numbers that are written by hand in the README and the page on padgs+ are those of the measured tables."""

import re
from importlib.util import module_from_spec, spec_from_file_location
from statistics import fmean

import pytest
from scipy.stats import ttest_1samp

SCENES = {
    **{name: f"{name} (not tuned on)" for name in ("basement", "plaza")},
    "bare room": r"synthetic-bare\_room (generated, not tuned on)",
    "pole torture": r"synthetic-pole\_torture (generated, not tuned on)",
    "near clutter": r"synthetic-near\_clutter (generated, tuned on)",
    "court": "synthetic-outdoor-other-path (generated, tuned on)",
    **{name: f"{name} (tuned on)" for name in ("bedroom", "flat", "room")},
}
NOT_TUNED_ON, TUNED_ON = list(SCENES)[:4], list(SCENES)[4:]
PUBLISHED = ("OP43DGS, corrected", "ODGS, corrected", "OmniGS, corrected", "SPaGS", "SPaGS, sorted", "PaD-GS")
TUNED, SAMPLED = "SPaGS, tuned", "SPaGS, tuned, four samples a pixel"
COMPLETE = "SPaGS, tuned; samples, response, steps and backgrounds of padgs+"
WS_PSNR, POLE, COUNT = "WS-PSNR ↑", "WS-PSNR pole ↑", "Gaussians"
SHOWN = {  # row of docs/plus.md -> column of the table, format, factor
    "WS-PSNR": (WS_PSNR, ".2f", 1),
    "PSNR": ("PSNR ↑", ".2f", 1),
    "LPIPS": (r"LPIPS VGG \[0, 1\] ↓", ".3f", 1),
    "WS-PSNR of the polar bands": (POLE, ".2f", 1),
    "thousands of Gaussians": (COUNT, ".0f", 1e-3),
    "ms of a frame": ("ms per frame ↓", ".0f", 1),
}


def cells(line: str) -> list[str]:
    return [re.sub(r"\*\*|</?ins>", "", cell).strip() for cell in line.split("|")[1:-1]]


@pytest.fixture(scope="module")
def after_a_minute(root):
    """Scene -> method -> column -> mean, of the table after 60 s."""
    found = {}
    for block in (root / "reports/measured/equal_time.md").read_text().split("### ")[1:]:
        title, _, *lines = (line for line in block.splitlines() if not line.startswith("- "))
        head, _, *rows = (cells(line) for line in lines if line.startswith("|"))
        means = {row[0].partition(" (n=")[0]: dict(zip(head, row, strict=True)) for row in rows}
        found[title.partition(", 512x256, 60 s")[0]] = means
    return lambda scene, method, column: float(found[SCENES[scene]][method][column].split()[0])


def between(values, shown: str) -> str:
    return f"{min(values):{shown}} to {max(values):{shown}}".replace("-", "−").replace(",", " ")


def test_the_table_of_padgs_plus(root, after_a_minute):
    lines = (root / "docs/plus.md").read_text().splitlines()
    rows = {row[0]: row[1:] for row in map(cells, lines) if row}
    heading = next(row for row in map(cells, lines) if row and "`basement`" in row)
    assert [name.strip("`") for name in heading[1:]] == list(SCENES)
    complete = [f"{after_a_minute(scene, COMPLETE, WS_PSNR):.2f}" for scene in NOT_TUNED_ON]
    assert rows["WS-PSNR, `spags_complete`"] == [*complete, *["–"] * len(TUNED_ON)]
    for title, (column, shown, factor) in SHOWN.items():
        pairs = ([factor * after_a_minute(scene, method, column) for method in ("padgs+", TUNED)] for scene in SCENES)
        assert rows[title] == ["/".join(format(value, shown) for value in pair) for pair in pairs], title


def test_the_long_runs_of_padgs_plus(root):
    blocks = (root / "reports/measured/order.md").read_text().split("### ")
    rows = {row[0]: row[1:] for row in map(cells, (root / "docs/plus.md").read_text().splitlines()) if row}
    methods = ("padgs+", TUNED, SAMPLED, "padgs+, one sample a pixel", "SPaGS")
    shown = {
        "`basement`, `plaza`: WS-PSNR": (WS_PSNR, ".2f", 1),
        "CPU seconds": ("CPU s ↓", ".0f", 1),
        "Gaussians / 1000": (COUNT, ".0f", 1e-3),
        "frame, ms": ("ms per frame ↓", ".0f", 1),
    }
    found = []
    for scene in ("basement", "plaza"):
        title = rf"all\_methods: {scene} (not tuned on), 256x128, 3000 iterations"
        block = next(block for block in blocks if block.startswith(title))
        head, _, *lines = (cells(line) for line in block.splitlines() if line.startswith("|"))
        found.append({line[0].partition(" (n=")[0]: dict(zip(head, line, strict=True)) for line in lines})
    for title, (column, form, factor) in shown.items():
        values = [[f"{factor * float(of[m][column].split()[0]):{form}}" for of in found] for m in methods]
        assert rows[title] == [", ".join(pair) for pair in values], title
    leads = [float(of["padgs+"][WS_PSNR].split()[0]) - float(of[TUNED][WS_PSNR].split()[0]) for of in found]
    page = " ".join((root / "docs/plus.md").read_text().split())
    assert leads[0] < 0.1 and f"ties with `spags_tuned` on `basement` and is {leads[1]:.1f} dB above it on" in page


def test_the_table_of_opacity_modulation(root, after_a_minute):
    lines = (root / "docs/notes/padgs_paper.md").read_text().splitlines()
    rows = {row[0]: row[1:] for row in map(cells, lines) if row}
    for title, column in (("WS-PSNR", WS_PSNR), ("PSNR", "PSNR ↑"), ("WS-PSNR of the poles", POLE)):
        pairs = ([after_a_minute(s, method, column) for method in ("PaD-GS, unmodulated", "PaD-GS")] for s in SCENES)
        assert rows[title] == [" → ".join(f"{value:.2f}" for value in pair) for pair in pairs], title


def test_the_answers_of_the_readme(root, after_a_minute):
    of, scenes = after_a_minute, list(SCENES)
    leads = [of(s, "padgs+", WS_PSNR) - max(of(s, method, WS_PSNR) for method in PUBLISHED) for s in scenes]
    ahead, ahead_of_complete = (
        [of(s, "padgs+", WS_PSNR) - of(s, m, WS_PSNR) for s in NOT_TUNED_ON] for m in (TUNED, COMPLETE)
    )
    gains, at_poles = (
        [of(s, "PaD-GS, unmodulated", column) - of(s, "PaD-GS", column) for s in scenes] for column in (WS_PSNR, POLE)
    )
    assert abs(gains[scenes.index("plaza")]) < 0.05
    counts = {s: round(of(s, "padgs+", COUNT), -3) for s in scenes}
    furnished = [counts[s] for s in ("flat", "bedroom", "room")]
    frames = [sum(of(s, method, "ms per frame ↓") for s in NOT_TUNED_ON) / 4 for method in ("padgs+", COMPLETE, TUNED)]
    text, plus = (" ".join((root / page).read_text().split()) for page in ("README.md", "docs/plus.md"))
    lead = between(leads[: len(NOT_TUNED_ON)], ".1f")
    assert f"five published methods by {lead} dB WS-PSNR after a minute on four scenes not tuned on" in plus
    best = " | ".join(f"{max(of(s, method, WS_PSNR) for method in PUBLISHED):.2f}" for s in scenes)
    assert f"| WS-PSNR, best published: SPaGS, sorted | {best} |" in plus
    assert f"| WS-PSNR, `spags_supersampled` | {' | '.join(f'{of(s, SAMPLED, WS_PSNR):.2f}' for s in scenes)} |" in plus
    least = f"{min(leads[: len(NOT_TUNED_ON)]):.1f} dB"
    assert f"five published methods are {least} or more behind" in (root / "docs" / "index.md").read_text()
    over = [of(s, "padgs+", WS_PSNR) - max(of(s, method, WS_PSNR) for method in (TUNED, SAMPLED)) for s in TUNED_ON]
    p_complete, p_tuned = (ttest_1samp(leads, 0).pvalue for leads in (ahead_of_complete, ahead))
    difference = f"{fmean(ahead_of_complete):+.2f}".replace("-", "−")
    level = f"level (mean difference {difference} dB WS-PSNR, p = {p_complete:.2f})"
    lead_of_tuned = f"by {between(ahead, '.1f')} dB, {fmean(ahead):.2f} on average (p = {p_tuned:.3f})"

    answers = [
        f"padgs+ and `spags_complete`, SPaGS with all options of padgs+, are {level}",
        f"padgs+ leads `spags_tuned`, SPaGS without its response, samples, steps and backgrounds, {lead_of_tuned}",
        f"Five published methods as re-implemented here are {least} or more behind",
        f"A frame takes {frames[0]:.0f} ms, with `spags_complete` {frames[1]:.0f}, with `spags_tuned` {frames[2]:.0f}",
        f"({between([10 * round(of(s, 'PaD-GS', 'iterations') / 10) for s in scenes], '.0f')} iterations; the paper",
        f"{between([gain for gain in gains if gain > 0.05], '.1f')} dB WS-PSNR on eight of nine scenes",
        "changes nothing on `plaza`",
        f"costs {between(at_poles, '.1f')} dB on all nine",
        f"{counts['bare room']:.0f} for a bare room, {between(furnished, '.0f')} for three furnished ones",
        f"{counts['basement']:.0f} for a storey (`basement`), and {counts['near clutter']:.0f} and "
        f"{counts['pole torture']:.0f} for rooms of fine textures",
    ]
    answers[-2:] = [re.sub(r"(\d)(000)\b", r"\1 \2", answer) for answer in answers[-2:]]
    assert [answer for answer in answers if answer not in text] == [], "write these into the README"
    assert f"is {level}" in plus and f"leads `spags_tuned` {lead_of_tuned}" in plus
    assert f"the better of `spags_tuned` and `spags_supersampled` is {between(over, '.2f')} dB behind" in plus


def test_links_to_measured_tables_lead_to_pages_of_the_site(root):
    pytest.importorskip("mkdocs")
    spec = spec_from_file_location("docs_site", root / "docs" / "site.py")
    hook = module_from_spec(spec)
    spec.loader.exec_module(hook)
    links = "[a](../reports/measured/order.md#x), ![b](../../reports/measured/c.png), [d](../../docs/plus.md)"
    inside = "[a](measured/order.md#x), ![b](../measured/c.png), [d](../plus.md)"
    assert hook.on_page_markdown(links, page=None) == inside
    assert "hooks: [docs/site.py]" in (root / "mkdocs.yml").read_text()
