"""The search of the built site, in headless Chromium: a question of a user finds its page first."""

import functools
import http.server
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from doc_pages import ROOT
from playwright.sync_api import Browser
from processes import HANG

QUESTIONS = {
    "depth unit": "frames",
    "two cameras": "cameras",
    "look-alikes": "explanation/failures",
    "no masks": "segmentation",
    "how fast": "explanation/performance",
    "how much memory": "explanation/performance",
    "several robots": "service",
    "update an object": "objects",
    "why unknown": "unknown-objects",
    "licence": "index",
}
"""What a user types -> page that is found first."""


@pytest.mark.slow
def test_questions_find_their_page_first(browser: Browser, tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed (extra docs)")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    subprocess.run(command, cwd=ROOT, env=environment, check=True, timeout=HANG)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    page, first = browser.new_page(), {}
    page.set_default_timeout(1000 * HANG)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        site = f"http://127.0.0.1:{server.server_port}/"
        for question in QUESTIONS:
            page.goto(f"{site}index.html?q={question}")
            link = page.locator(".md-search-result__item a.md-search-result__link").first.get_attribute("href") or ""
            first[question] = link.partition("?")[0].partition("#")[0].removeprefix(site).removesuffix(".html")
        server.shutdown()
    page.close()
    assert first == QUESTIONS
