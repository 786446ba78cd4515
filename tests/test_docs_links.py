"""Links in the Markdown of the repository: files, anchors, and the paths named in the text."""

from __future__ import annotations

from pathlib import Path

import pytest
from site_tools.markdown_links import anchors, problems, slug

ROOT = Path(__file__).resolve().parents[1]
SKIPPED = {"_build", ".venv", "runs", "build", "dist", "node_modules"}
FOLDERS = ("*.md", "docs/**/*.md", "docs/**/*.ipynb", "experiments/**/*.md", ".github/**/*.md")
PAGES = sorted(
    path.relative_to(ROOT)
    for pattern in FOLDERS
    for path in ROOT.glob(pattern)
    if not SKIPPED & set(path.relative_to(ROOT).parts)
)


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_link_leads_somewhere(page: Path) -> None:
    assert problems(ROOT / page, ROOT) == []


def test_the_pages_are_found() -> None:
    assert {Path("README.md"), Path("docs/index.md"), Path("experiments/README.md")} <= set(PAGES)


@pytest.mark.parametrize(
    ("heading", "expected"),
    [
        ("What the actor sees", "what-the-actor-sees"),
        ("H100-class GPUs: a plan on paper", "h100-class-gpus-a-plan-on-paper"),
        ("8. What is counted", "8-what-is-counted"),
        ("`Config` fields", "config-fields"),
        ("GPUs, TPUs, clusters", "gpus-tpus-clusters"),
    ],
)
def test_anchors_are_those_of_github(heading: str, expected: str) -> None:
    assert expected in anchors(f"# {heading}\n")


def test_a_heading_that_comes_twice_is_numbered() -> None:
    assert anchors("# Memory\n\n## Memory\n") == {"memory", "memory-1"}
    assert slug("A & B") == "a--b"


def test_what_leads_nowhere_is_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# There\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[a](other.md#there) [b](other.md#gone) [c](gone.md) ![d](gone.png) [e](#here)\n\n"
        "`tests/test_gone.py` and `other.md`, `RUN/curve.png`; [f](https://example.com/#any)\n\n"
        "| [g](gone.csv) |\n| --- |\n| cell |\n\n## Here\n"
    )
    assert problems(page, tmp_path) == [
        "page.md: other.md#gone: no such anchor",
        "page.md: gone.md: no such file",
        "page.md: gone.png: no such file",
        "page.md: `tests/test_gone.py`: no such file",
        "page.md: gone.csv: no such file",
    ]
