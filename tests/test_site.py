"""The site, opened from the disk without a network: nothing comes from elsewhere, and its search finds."""

import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Two pages with the site's theme and plugins; the reference of the code, which takes long, is left out."""
    config = pytest.importorskip("mkdocs.config")
    from mkdocs.commands.build import build

    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(ROOT / "docs" / "javascripts", folder / "docs" / "javascripts")
    (folder / "docs" / "index.md").write_text("# Home\n\nNothing here.\n")
    (folder / "docs" / "deep").mkdir()
    (folder / "docs" / "deep" / "gripper.md").write_text("# Gripper\n\nA parallel gripper squeezes the cube.\n")
    text = re.sub(
        r"  - autorefs\n  - mkdocstrings:.*?(?=^\w)", "", (ROOT / "mkdocs.yml").read_text(), flags=re.S | re.M
    )
    text = re.sub(r"^hooks:.*\n|^nav:\n(?:  .*\n)+", "", text, flags=re.MULTILINE)
    (folder / "mkdocs.yml").write_text(text)
    loaded = config.load_config(str(folder / "mkdocs.yml"))
    build(loaded)
    return Path(loaded.site_dir)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_search_from_the_disk_without_a_network(site):
    from tests.bam_train.agent.browsers import Page, new_browser, until

    browser = new_browser("--host-resolver-rules=MAP * ~NOTFOUND")
    try:
        page = Page(browser)
        browser.get((site / "deep" / "gripper.html").as_uri())
        box = browser.find_element("css selector", "input[data-md-component=search-query]")
        page.run("arguments[0].focus()", box)
        until(box.is_displayed, "the search box")
        box.send_keys("squeezes")
        results = until(lambda: browser.find_elements("css selector", ".md-search-result__link"), "a result")
        assert results[0].get_attribute("href").startswith((site / "deep" / "gripper.html").as_uri())
        assert [url for url in page.requested() if url.startswith("http")] == []
    finally:
        browser.quit()
