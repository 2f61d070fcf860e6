import shutil
import subprocess

import pytest
from made_up import failed, result

from reports import latex, table3
from reports.request import Request


@pytest.fixture
def text() -> str:
    return latex.text(table3.build([result("full"), failed("baseline", "oom")], Request()))


def test_every_line_of_the_tabular_has_all_columns(text):
    body = text.split(r"\begin{tabular}{lrrrrrrrrr}")[1].split(r"\end{tabular}")[0]
    rows = [line for line in body.splitlines() if line.strip().endswith(r"\\") and "multicolumn" not in line]
    assert len(rows) == 1 + 4 + 4
    assert all(row.replace(r"\&", "").count("&") == 9 for row in rows)


def test_what_latex_would_misread_is_escaped(text):
    assert r"A \& B\_1" in text and r"cat\_tower" in text
    assert not {"±", "Δ", "↑", "–"} & set(text)


def test_numbers_and_emphasis(text):
    assert r"\textbf{0.808}" in text and "OOM" in text and "$+$0.10" in text


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex here")
def test_it_compiles(text, tmp_path):
    document = rf"\documentclass{{article}}\usepackage{{booktabs}}\begin{{document}}{text}\end{{document}}"
    (tmp_path / "table.tex").write_text(document)
    command = ["pdflatex", "-halt-on-error", "table.tex"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
