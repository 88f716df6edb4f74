"""The files of the console: all there, small, and good without internet and under the strict policy of their server."""

import gzip
import re

import pytest

from bam_train.agent.front.front_process import console_pages

EVERY = {path: page.body.decode() for path, page in console_pages().items()}
CHARTS = {"/uPlot.iife.min.js", "/uPlot.min.css", "/uplot.LICENSE.txt"}
SOLIDS = {"/three.module.min.js", "/three.core.min.js", "/OrbitControls.js", "/three.LICENSE.txt"}
ROBOT = {"/picture.js", "/scene.js"}
PAGES = {path: text for path, text in EVERY.items() if path not in CHARTS | SOLIDS}


def test_the_pages():
    scripts = {path for path in PAGES if path.endswith(".js")}
    assert scripts >= {"/main.js", "/connection.js", "/jogging.js"}
    assert set(PAGES) - scripts == {"/", "/index.html", "/console.css", "/icon.svg", "/keys.json"}
    assert PAGES["/"] == PAGES["/index.html"]
    assert set(EVERY) - set(PAGES) == CHARTS | SOLIDS, "install this project again: pip install -e ."
    first, later = (
        sum(len(gzip.compress(EVERY[path].encode())) for path in paths)
        for paths in (set(EVERY) - SOLIDS - ROBOT, SOLIDS | ROBOT)
    )
    assert first < 50_000, "what stops the robot comes at once, over a slow network too"
    assert later < 200_000


def test_every_file_that_a_page_names_is_there():
    named = re.findall(r'(?:href|src)="([^"]+)"', PAGES["/"])
    pattern = r"""(?:from ?["']\./|import\("\./|fetch\("|Worker\(")([\w.]+)["']"""
    named += [name for path, text in EVERY.items() if path.endswith(".js") for name in re.findall(pattern, text)]
    licences = {"/uplot.LICENSE.txt", "/three.LICENSE.txt"}
    assert {f"/{name}" for name in named} == set(EVERY) - {"/", "/index.html"} - licences
    assert "from 'three';" not in EVERY["/OrbitControls.js"], "a page has no import map"


@pytest.mark.parametrize("path", sorted(PAGES))
def test_nothing_comes_from_elsewhere_and_no_code_stands_in_the_page(path):
    text = PAGES[path].replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?://|//[a-z]+\.", text)
    assert not re.search(r"\beval\(|innerHTML|document\.write|new Function", text)
    if path.endswith("html"):
        assert not re.search(r"<script>|<style>|\sstyle=|\son[a-z]+=", text)
