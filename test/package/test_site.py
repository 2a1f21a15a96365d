"""The pages for users build strictly, and the site loads nothing from elsewhere."""

import os
import re
import subprocess
import sys

import pytest
import yaml

# What a browser fetches by itself; links that a reader clicks are not in it.
FETCHED = re.compile(
    r"<(?:script|img|iframe)[^>]*\bsrc=[\"']?https?://|"
    r"<link[^>]*rel=[\"']?(?:stylesheet|preconnect|preload|icon)[\"']?[^>]*https?://|"
    r"@import url\(http"
)


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_the_site_has_all_pages_builds_strictly_and_fetches_nothing(root_dir, tmp_path):
    pytest.importorskip("mkdocs", reason="pip install 'deworldsg_ros[docs]'")
    text = (root_dir / "mkdocs.yml").read_text(encoding="utf-8")
    pages = [page for entry in yaml.safe_load(text)["nav"] for page in entry.values()]
    assert len(pages) == 8
    assert set(pages) == {path.name for path in (root_dir / "docs").glob("*.md")}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=root_dir, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    built = list(tmp_path.rglob("*.html"))
    assert len(built) >= 8
    for path in built:
        assert not FETCHED.search(path.read_text(encoding="utf-8")), path
    # A moving picture that a phone can load.
    assert (tmp_path / "images" / "growing.webp").stat().st_size < 1_500_000
