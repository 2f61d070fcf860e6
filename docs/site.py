"""Hook of mkdocs: measured tables and charts, to which pages link, are in the site too."""

import re
from pathlib import Path

from mkdocs.structure.files import File

REPORTS = Path(__file__).resolve().parent.parent / "reports"


def on_files(files, config):
    """Add `reports/measured` to the files of the site."""
    for path in sorted(REPORTS.glob("measured/*")):
        if path.suffix in (".md", ".png", ".json"):
            files.append(File(f"measured/{path.name}", str(REPORTS), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown, **_):
    """Return a page with links as they are in the site, where `measured` lies beside the pages of `docs`."""
    markdown = re.sub(r"\]\(\.\./((?:\.\./)?)reports/measured/", r"](\1measured/", markdown)
    return re.sub(r"\]\(\.\./\.\./docs/", "](../", markdown)
