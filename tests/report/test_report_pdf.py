"""A report as PDF: by the browser that is there, or a clear line."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from geomosaic.errors import InputError
from geomosaic.report.pdf import browser, print_page

PAGE = "<!DOCTYPE html><html><body><h1>Good</h1><p>seams 0.4 px</p></body></html>"


def test_without_a_browser_the_option_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="--pdf needs a browser"):
        browser()


@pytest.mark.skipif(
    not any(shutil.which(name) for name in ("chromium", "google-chrome")), reason="no Chromium here"
)
def test_a_page_is_printed(tmp_path: Path) -> None:
    page, target = tmp_path / "report, 1.html", tmp_path / "report.pdf"
    page.write_text(PAGE, encoding="utf-8")
    print_page(page, target)
    assert target.read_bytes().startswith(b"%PDF-") and target.stat().st_size > 2000
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report, 1.html", "report.pdf"]


def test_what_prints_nothing_is_no_pdf(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A program of that name that does nothing."""
    (tmp_path / "chromium").symlink_to(shutil.which("true") or "/bin/true")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="printed no PDF"):
        print_page(tmp_path / "page.html", tmp_path / "report.pdf")
    assert not (tmp_path / "report.pdf").exists()
