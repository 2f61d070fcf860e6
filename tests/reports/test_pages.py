"""Numbers that are written by hand in the README and in pages are those of the measured tables."""

import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from statistics import fmean

import pytest
from scipy.stats import ttest_1samp

ROOT = Path(__file__).resolve().parents[2]
SCENES = {
    **{name: f"{name} (not tuned on)" for name in ("basement", "plaza")},
    "bare room": r"synthetic-bare\_room (generated, not tuned on)",
    "pole torture": r"synthetic-pole\_torture (generated, not tuned on)",
    "near clutter": r"synthetic-near\_clutter (generated, tuned on)",
    "court": "synthetic-outdoor-other-path (generated, tuned on)",
    **{name: f"{name} (tuned on)" for name in ("bedroom", "flat", "room")},
}
NOT_TUNED_ON, TUNED_ON = list(SCENES)[:4], list(SCENES)[4:]
LONG = ("basement", "plaza")
NAMES = {  # in the pages -> in the tables
    "padgs+": "padgs+",
    "`spags_complete`": "SPaGS, complete",
    "`spags_supersampled`": "SPaGS, supersampled",
    "`spags_tuned`": "SPaGS, tuned",
    "`spags_sorted`": "SPaGS, sorted",
}
COMPLETE, SAMPLED, TUNED, SORTED = list(NAMES.values())[1:]
WITHOUT_OPTIONS = ("OP43DGS, corrected", "ODGS, corrected", "OmniGS, corrected", "SPaGS", SORTED, "PaD-GS")
WS_PSNR, POLE, COUNT, FRAME = "WS-PSNR ↑", "WS-PSNR pole ↑", "Gaussians", "ms per frame ↓"
MEANS = {  # column of docs/plus.md -> column of the table, format, factor
    "PSNR": ("PSNR ↑", ".2f", 1),
    "LPIPS": (r"LPIPS VGG \[0, 1\] ↓", ".3f", 1),
    "WS-PSNR of the poles": (POLE, ".2f", 1),
    "Gaussians / 1000": (COUNT, ".0f", 1e-3),
    "frame, ms": (FRAME, ".0f", 1),
}
LONG_RUNS = {
    "WS-PSNR": (WS_PSNR, ".2f", 1),
    "CPU s": ("CPU s ↓", ".0f", 1),
    "Gaussians / 1000": (COUNT, ".0f", 1e-3),
    "frame, ms": (FRAME, ".0f", 1),
}


def cells(line: str) -> list[str]:
    return [re.sub(r"\*\*|</?ins>", "", cell).strip() for cell in line.split("|")[1:-1]]


def blocks(name: str) -> dict[str, dict[str, dict[str, str]]]:
    """Title of a block -> method -> column -> text of a measured table."""
    found = {}
    for block in (ROOT / "reports" / "measured" / f"{name}.md").read_text().split("### ")[1:]:
        title, _, *lines = (line for line in block.splitlines() if not line.startswith("- "))
        head, _, *rows = (cells(line) for line in lines if line.startswith("|"))
        found[title] = {
            row[0].partition(" (n=")[0].removesuffix(" †"): dict(zip(head, row, strict=True)) for row in rows
        }
    return found


def number(text: str) -> float:
    return float(text.split()[0])


def text_of(page: str) -> str:
    return " ".join((ROOT / page).read_text().split())


def minus(text: str) -> str:
    return text.replace("-", "−")


def between(values, shown: str) -> str:
    return minus(f"{min(values):{shown}} to {max(values):{shown}}").replace(",", " ")


def thousands(count: float) -> str:
    return f"{round(count, -3):,.0f}".replace(",", " ")


class Minute:
    """The table after a minute."""

    def __init__(self):
        found = blocks("equal_time")
        (mean,) = (title for title in found if title.startswith("Average over 4 scenes not tuned on"))
        self.mean = found[mean]
        self.of_scene = {name: found[f"{title}, 512x256, 60 s of CPU time"] for name, title in SCENES.items()}

    def of(self, scene: str, method: str, column: str) -> float:
        return number(self.of_scene[scene][method][column])

    def leads(self, rival, scenes=NOT_TUNED_ON, column: str = WS_PSNR, ours: str = "padgs+") -> list[float]:
        """Return by how much a method is above a rival, or the best of several, on each scene."""
        rivals = (rival,) if isinstance(rival, str) else rival
        return [self.of(s, ours, column) - max(self.of(s, other, column) for other in rivals) for s in scenes]

    def mean_of(self, method: str, column: str) -> float:
        return number(self.mean[method][column])


def long_runs() -> dict[str, dict[str, dict[str, str]]]:
    """Scene -> method -> column of the runs of 3000 iterations."""
    found = blocks("order")
    return {
        name: next(of for title, of in found.items() if title.startswith(rf"all\_methods: {name}") and "padgs+" in of)
        for name in LONG
    }


def tables(minute: Minute) -> dict[str, list[list[str]]]:
    """Return the rows of the tables of docs/plus.md, by the heading of their second column."""
    in_scenes = {
        kind: [
            [name, *(f"{minute.of(scene, method, WS_PSNR):.2f}" for scene in scenes)]
            for name, method in NAMES.items()
            if all(method in minute.of_scene[scene] for scene in scenes)
        ]
        for kind, scenes in (("`basement`", NOT_TUNED_ON), ("near clutter", TUNED_ON))
    }
    for row, method in zip(in_scenes["`basement`"], NAMES.values(), strict=True):
        row.append(f"{minute.mean_of(method, WS_PSNR):.2f}")
    means = [
        [name, *(f"{factor * minute.mean_of(method, column):{form}}" for column, form, factor in MEANS.values())]
        for name, method in NAMES.items()
    ]
    of = long_runs()
    several = [
        [name, *(", ".join(f"{k * number(of[s][m][c]):{form}}" for s in LONG) for c, form, k in LONG_RUNS.values())]
        for name, m in (NAMES | {"SPaGS": "SPaGS"}).items()
    ]
    return in_scenes | {"PSNR": means, "WS-PSNR": several}


def statements(minute: Minute) -> dict[str, str]:
    """Return phrases of the README and the pages."""
    (claim,) = (
        row
        for row in map(cells, (ROOT / "docs" / "findings.md").read_text().splitlines())
        if row[:2] == ["11", "WS-PSNR"]
    )
    assert minute.leads(WITHOUT_OPTIONS) == minute.leads(SORTED)
    ahead = minute.leads(TUNED)
    p = ttest_1samp(ahead, 0).pvalue
    everywhere = list(SCENES)
    gains = minute.leads("PaD-GS", everywhere, ours="PaD-GS, unmodulated")
    at_poles = minute.leads("PaD-GS", everywhere, POLE, "PaD-GS, unmodulated")
    assert [scene for scene, gain in zip(everywhere, gains, strict=True) if gain < 0.05] == ["plaza"]
    assert min(at_poles) > 0
    cost = between([gain for gain in gains if gain >= 0.05], ".1f")
    counts = {scene: minute.of(scene, "padgs+", COUNT) for scene in everywhere}
    furnished = between([round(counts[scene], -3) for scene in ("flat", "bedroom", "room")], ",.0f")
    fine = " and ".join(thousands(counts[scene]) for scene in ("near clutter", "pole torture"))
    storey = thousands(counts["basement"])
    iterations = [10 * round(minute.of(scene, "PaD-GS", "iterations") / 10) for scene in everywhere]
    unmodulated, modulated = (
        number(long_runs()["basement"][method][WS_PSNR]) for method in ("PaD-GS, unmodulated", "PaD-GS")
    )
    return {
        "DIFF": f"{minus(claim[2])} dB WS-PSNR, 95 % interval {minus(claim[3])}",
        "LEADTUNED": f"by {between(ahead, '.1f')} dB, {fmean(ahead):.2f} on average (p = {p:.3f})",
        "LEADS": between(minute.leads(WITHOUT_OPTIONS), ".1f"),
        "FRAMES": "A frame takes {:.0f} ms, with `spags_complete` {:.0f}, with `spags_tuned` {:.0f}".format(
            *(minute.mean_of(method, FRAME) for method in ("padgs+", COMPLETE, TUNED))
        ),
        "MODULATION": f"After a minute ({between(iterations, '.0f')} iterations; the paper has 30 000) it costs PaD-GS "
        f"{cost} dB WS-PSNR on eight of nine scenes and changes nothing on `plaza`; at the poles it costs "
        f"{between(at_poles, '.1f')} dB on all nine",
        "MODULATIONLONG": f"After 3000 iterations on `basement` it costs {unmodulated - modulated:.1f} dB",
        "MODULATIONSHORT": f"it costs {cost} dB WS-PSNR on eight of nine scenes, and {between(at_poles, '.1f')} dB at "
        "the poles",
        "COUNTS": f"{thousands(counts['bare room'])} for a bare room, {furnished} for three furnished ones (`flat`, "
        f"`bedroom`, `room`), {storey} for a storey (`basement`), and {fine} for rooms of fine textures",
        "FURNISHED": furnished,
        "STOREY": storey,
        "RATIO": between([counts[s] / minute.of(s, TUNED, COUNT) for s in everywhere], ".1f"),
    }


USED = {
    "README.md": ("DIFF", "LEADTUNED", "LEADS", "FRAMES", "MODULATION", "MODULATIONLONG", "COUNTS"),
    "docs/plus.md": ("DIFF", "LEADTUNED", "LEADS"),
    "docs/index.md": ("LEADS", "MODULATIONSHORT", "FURNISHED", "STOREY"),
    "docs/smallest.md": ("FURNISHED", "STOREY", "RATIO"),
}


@pytest.fixture(scope="module")
def minute():
    return Minute()


@pytest.mark.parametrize("page", USED)
def test_the_statements_of_a_page(page, minute):
    text, known = text_of(page), statements(minute)
    assert [known[name] for name in USED[page] if known[name] not in text] == [], f"write these into {page}"


def test_the_tables_of_padgs_plus(minute):
    lines = [cells(line) for line in (ROOT / "docs" / "plus.md").read_text().splitlines() if line.startswith("|")]
    for second, rows in tables(minute).items():
        (start,) = (i for i, line in enumerate(lines) if line[1] == second and line[0] != "without")
        assert lines[start + 2 : start + 2 + len(rows)] == rows, second
    better = minute.leads((TUNED, SAMPLED), TUNED_ON)
    assert f"the better of both is {between(better, '.2f')} dB behind" in text_of("docs/plus.md")


def test_the_table_of_opacity_modulation(minute):
    rows = {row[0]: row[1:] for row in map(cells, (ROOT / "docs/notes/padgs_paper.md").read_text().splitlines()) if row}
    for title, column in (("WS-PSNR", WS_PSNR), ("PSNR", "PSNR ↑"), ("WS-PSNR of the poles", POLE)):
        pairs = ([minute.of(s, method, column) for method in ("PaD-GS, unmodulated", "PaD-GS")] for s in SCENES)
        assert rows[title] == [" → ".join(f"{value:.2f}" for value in pair) for pair in pairs], title


def test_links_to_measured_tables_lead_to_pages_of_the_site():
    pytest.importorskip("mkdocs")
    spec = spec_from_file_location("docs_site", ROOT / "docs" / "site.py")
    hook = module_from_spec(spec)
    spec.loader.exec_module(hook)
    links = "[a](../reports/measured/order.md#x), ![b](../../reports/measured/c.png), [d](../../docs/plus.md)"
    inside = "[a](measured/order.md#x), ![b](../measured/c.png), [d](../plus.md)"
    assert hook.on_page_markdown(links, page=None) == inside
    assert "hooks: [docs/site.py]" in (ROOT / "mkdocs.yml").read_text()
