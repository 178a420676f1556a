"""Docs that a command makes are the ones that are committed."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).parent.parent


def make_docs():
    spec = importlib.util.spec_from_file_location("make_docs", ROOT / "benchmarks" / "make_docs.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_methods_page_is_fresh():
    committed = (ROOT / "docs" / "methods.md").read_text(encoding="utf-8")
    assert committed == make_docs().methods_md(), "run python benchmarks/make_docs.py"


def test_results_are_fresh():
    docs = make_docs()
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert page == docs.results_md(), "run python benchmarks/make_docs.py"
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    fresh = docs.replace_block(readme, "results", docs.readme_md())
    assert readme == fresh, "run python benchmarks/make_docs.py"
