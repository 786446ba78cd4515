"""What a repository has besides code: citation, notebooks without outputs, no large files."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from sacformer_jax import __version__

ROOT = Path(__file__).resolve().parents[1]
LARGEST = 1_000_000
"""Bytes of a file."""


def _tracked() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("no git here")
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()]


def test_citation_is_valid_and_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    # What the schema of the Citation File Format 1.2.0 requires.
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] in ("software", "dataset")
    assert citation["authors"] == [{"name": "The sacformer-jax authors"}]
    assert citation["version"] == __version__
    allowed = {
        "abstract", "authors", "cff-version", "commit", "contact", "date-released", "doi",
        "identifiers", "keywords", "license", "license-url", "message", "preferred-citation",
        "references", "repository", "repository-artifact", "repository-code", "title", "type",
        "url", "version",
    }  # fmt: skip
    assert set(citation) <= allowed
    assert all(isinstance(word, str) for word in citation["keywords"])


def test_the_version_is_semantic() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?(\+[0-9A-Za-z.-]+)?", __version__)


@pytest.mark.parametrize("path", sorted(ROOT.glob("docs/notebooks/*.ipynb")), ids=lambda p: p.name)
def test_notebooks_are_kept_without_outputs(path: Path) -> None:
    code = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    assert code
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)


def test_forms_of_issues_are_as_github_wants_them() -> None:
    for path in sorted(ROOT.glob(".github/ISSUE_TEMPLATE/*.yml")):
        form = yaml.safe_load(path.read_text())
        if path.name == "config.yml":
            continue
        assert {"name", "description", "body"} <= set(form), path.name
        asked = [part for part in form["body"] if part["type"] != "markdown"]
        assert len({part["id"] for part in asked}) == len(asked)
        assert all(part["attributes"]["label"] for part in asked)


def test_the_workflow_runs_what_we_call_ci() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    steps = [step.get("run", "") for job in workflow["jobs"].values() for step in job["steps"]]
    assert ".ci/run" in steps
    targets = re.findall(r"^make (\w+)$", (ROOT / ".ci/run").read_text(), re.MULTILINE)
    (check,) = re.findall(r"^check: ([^#]+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert targets == check.split()


def test_make_alone_explains_every_target() -> None:
    # As from a shell, though the tests are run by make themselves.
    outside = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    told = subprocess.run(
        ["make"], cwd=ROOT, capture_output=True, text=True, check=True, env=outside
    ).stdout
    (phony,) = re.findall(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    explained = [line.split()[0] for line in told.splitlines()]
    assert sorted(explained) == sorted(phony.split())
    assert all(len(line.split()) > 1 for line in told.splitlines())


def test_hooks_are_local_and_their_programs_are_tools_of_development() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [repository["repo"] for repository in hooks] == ["local"]
    entries = [hook["entry"].split()[0] for hook in hooks[0]["hooks"]]
    assert set(entries) <= {".venv/bin/ruff", ".venv/bin/mypy", ".venv/bin/python"}


def test_files_are_small_and_text_has_no_trailing_space() -> None:
    for path in _tracked():
        assert path.stat().st_size <= LARGEST, path
        if path.suffix in (".py", ".toml", ".yml", ".yaml", ".cff", ".sh"):
            text = path.read_text()
            assert not re.search(r"[ \t]$", text, re.MULTILINE), path
            assert text.endswith("\n") or not text, path
            assert not re.search(r"^(<{7}|>{7}) ", text, re.MULTILINE), path
