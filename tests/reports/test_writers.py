import re
import shutil
import subprocess
from dataclasses import replace

import pytest
from PIL import Image
from support.made_up import builder, data_set, failed, result, run_set

from padgs.reports.charts.drawing import Chart
from padgs.reports.table import Cell, Column, Row
from padgs.reports.writers import _line, files, latex

runs = builder("runs")
table1 = builder("table1")
table2 = builder("table2")
table4 = builder("table4")
table3 = builder("table3")

ABLATION = [
    *(replace(result("full"), seed=seed) for seed in range(3)),
    *(replace(result("dagd", ssim=0.804), seed=seed) for seed in range(3)),
    failed("baseline", "oom"),
]


@pytest.fixture
def text() -> str:
    return latex(table3(run_set(ABLATION)))


def test_every_line_of_the_tabular_has_all_columns(text):
    body = text.split(r"\begin{tabular}{lrrrrrrrrr}")[1].split(r"\end{tabular}")[0]
    rows = [line for line in body.splitlines() if line.strip().endswith(r"\\") and "multicolumn" not in line]
    assert len(rows) == 1 + 4
    assert all(row.replace(r"\&", "").count("&") == 9 for row in rows)


def test_what_latex_would_misread_is_escaped(text):
    assert r"A \& B\_1" in text
    assert not {"±", "Δ", "↑", "–"} & set(text)


def test_no_name_is_a_command_or_ends_a_paragraph():
    evil = result("[3pt] \\input{x}\n\n%", scene="b\x1b\n\nar", dataset="")
    text = latex(runs(run_set([evil], mix=True)))
    (row,) = [line for line in text.splitlines() if "input" in line]
    assert r"\textbackslash{}input\{x\}\textbackslash{}n" in row and "\x1b" not in text and "\n\n" not in text
    assert r"\caption{Runs: b\textbackslash{}x1b\textbackslash{}n\textbackslash{}nar" in text
    assert _line(["[3pt]", "1"]) == r"    {}[3pt] & 1 \\"


def test_numbers_and_emphasis(text):
    assert r"\textbf{0.810" in text and r"\underline{0.804" in text and "OOM" in text and "$+$0.10" in text


def test_each_block_is_a_table_of_its_own():
    text = latex(table1(run_set(data_set("roam360"))))
    assert text.count(r"\begin{tabular}") == text.count(r"\toprule") == text.count(r"\label") == 1 + 3
    assert r"\caption{Quality on indoor and other scenes: 360Roam, average over its 11 scenes}" in text


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex here")
def test_they_compile(tmp_path):
    results = [*data_set("roam360"), *data_set("ricoh360", seeds=2)]
    tables = [build(run_set(results)) for build in (table1, table2, table4)]
    body = "\n".join(latex(table) for table in (*tables, table3(run_set(ABLATION)), runs(run_set(results))))
    packages = r"\usepackage{adjustbox, booktabs, pdflscape}"
    document = rf"\documentclass{{article}}{packages}\begin{{document}}{body}\end{{document}}"
    (tmp_path / "tables.tex").write_text(document)
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "tables.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Undefined control sequence" not in done.stdout
    too_wide = re.findall(r"Overfull .hbox .([\d.]+)pt too wide. in alignment", done.stdout)
    assert max(map(float, too_wide), default=0) < 1


def test_charts_of_scenes_whose_names_differ_in_signs_only_have_files_of_their_own():
    charts = [Chart("chart_a/b", "a/b", Image.new("RGB", (1, 1))), Chart("chart_a-b", "a-b", Image.new("RGB", (1, 1)))]
    names = [name for name, _ in files(charts)]
    assert names[0] == "chart_a-b.png" and re.fullmatch(r"chart_a-b-[0-9a-f]{9}\.png", names[1])


def test_numbers_of_seeds_stand_beside_cells_where_they_differ():
    columns = [Column("PSNR", 1)] * 3
    limit, three, one = Cell(2.0, count=0), Cell(1.5, 0.1, 3), Cell(2.5)
    assert Row("a", (limit, three, three)).texts(columns)[0] == "a (n=3)", "a limit is of no run"
    assert Row("a", (limit, three, one)).texts(columns) == ["a", "2.0", "1.5 ± 0.1 (n=3)", "2.5 (n=1)"]
    assert Row("a", (limit, one, one)).texts(columns) == ["a", "2.0", "2.5", "2.5"]
    assert [cell.numbers["n"] for cell in (limit, three, one, Cell())] == [None, 3, 1, None]
