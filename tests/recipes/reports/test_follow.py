"""Pages of single runs and of unfinished studies, which are written again while training goes on."""

from __future__ import annotations

import functools
import http.server
import json
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

from torchrl_her_envs.common.rendering import video
from torchrl_her_envs.common.rendering.video import write_video
from torchrl_her_recipes import Followed, follow
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.reports import compare
from torchrl_her_recipes.reports import follow as following
from torchrl_her_recipes.reports import page as page_module
from torchrl_her_recipes.reports.follow import _tell
from torchrl_her_recipes.reports.page import Live, describe, render
from torchrl_her_recipes.reports.runs import read_runs
from torchrl_her_recipes.runs.folder import RunFolder

from .small_study import STUDY, write_run
from .test_page import Checker, text_of

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None
)


@pytest.fixture(autouse=True)
def _quick_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing and intervals take seconds, and are tested with the pages of studies."""
    monkeypatch.setattr(compare, "bootstrap", functools.partial(compare.bootstrap, repetitions=10))
    monkeypatch.setattr(page_module, "draw_pictures", lambda cells, finals, figures: {})


def write_epochs(folder: Path, epochs: int, *, done: bool = False) -> Path:
    """The folder of a run that is so far; it has three epochs."""
    home = folder / "hand_v2_her"
    shutil.rmtree(home, ignore_errors=True)
    write_run(folder, STUDY, "hand_v2_her", [0.25, 0.75], epochs=epochs)
    if not done:
        (home / "policy.pt").unlink()
    return home


def test_a_run_that_goes_on_and_one_at_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    home = write_epochs(tmp_path, 2)
    assert main(["report", str(home)]) == 0
    assert capsys.readouterr().out == f"{home}/report/index.html\n"
    page = (home / "report" / "index.html").read_text()
    text = text_of(page)
    assert text.startswith("Run hand_v2_her hand_v2 hand_v2_her 2 of 3 epoch 2 of 3, 2,000 frames")
    assert "success 50 %" in text
    assert "task.name=hand_v2" in text
    assert "thesis" not in text
    assert "<script" not in page
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    write_epochs(tmp_path, 3, done=True)
    write_video([torch.zeros(8, 8, 3, dtype=torch.uint8)] * 2, home / "play.gif")
    assert main(["report", str(home), "--out", str(tmp_path / "page")]) == 0
    page = (tmp_path / "page" / "index.html").read_text()
    assert "epoch 3 of 3" in text_of(page)
    assert '<img src="data:image/gif;base64,' in page
    assert "The newest film, hand_v2_her/play.gif" in page


def test_several_runs_and_folders_of_runs_share_a_page(tmp_path: Path) -> None:
    for label in ("hand_v2_her", "robot_v2_her"):
        write_run(tmp_path / "sweep", STUDY, label, [0.5])
    page = Path(recipes_page(tmp_path / "sweep", out=tmp_path / "a")).read_text()
    both = Path(recipes_page(*sorted((tmp_path / "sweep").iterdir()), out=tmp_path / "b")).read_text()
    for own in (page, both):
        assert "Runs" in own
        assert re.findall(r'<span class="name">(\w+)</span>', own) == ["hand_v2_her", "robot_v2_her"]


def recipes_page(*folders: Path, out: Path) -> str:
    assert main(["report", *map(str, folders), "--out", str(out)]) == 0
    return str(out / "index.html")


def test_what_was_not_trained_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    home = write_epochs(tmp_path, 1)
    (tmp_path / "empty").mkdir()
    for arguments, message in (
        (
            [str(tmp_path / "empty")],
            "empty is no folder of a run: neither it nor a folder",
        ),
        ([str(home), str(tmp_path / "none")], "none is no folder of a run"),
        ([str(home), "--folder", "x"], "--folder goes with the name of a study"),
        ([str(home), "--export", "x"], "--export goes with the name of a study"),
        (["bias", str(home)], "a page is about one study or about folders of runs, got bias, "),
        (["bias", "--follow", "--export", "x"], "--export and --follow cannot be given together"),
        ([str(home), "--follow", "--every", "0"], "0.0 is not in the range x>=0.1"),
    ):
        assert main(["report", *arguments]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1


# Files that are being written


def test_a_line_without_an_end_is_not_read_nor_the_epoch_that_it_belongs_to(tmp_path: Path) -> None:
    home = RunFolder(write_epochs(tmp_path, 2))
    whole = home.metrics.read_text()
    assert [row["epoch"] for row in home.rows(going_on=True)] == [1, 1, 2, 2]
    for cut in (1, 3, 30):  # in the last line; one cut in a number would still be a number
        home.metrics.write_text(whole[:-cut])
        assert [row["epoch"] for row in home.rows(going_on=True)] == [1, 1]
    home.metrics.write_text(whole[: whole.index("\n") - 3])
    assert home.rows(going_on=True) == []
    home.metrics.write_text("")
    assert home.rows(going_on=True) == []
    home.metrics.write_text(whole[:-3])
    (cell,) = read_runs([home.path]).cells
    assert cell.state == "at epoch 1 of 3"


def test_at_any_moment_the_page_is_whole(tmp_path: Path) -> None:
    """Somebody reads it again and again while it is written 20 times."""
    described = describe(read_runs([write_epochs(tmp_path, 2)]), make(tmp_path / "page"))
    render(described, tmp_path / "page")
    broken, over = [], threading.Event()

    def read() -> None:
        while not over.is_set():
            text = (tmp_path / "page" / "index.html").read_text()
            if not text.rstrip().endswith("</html>"):
                broken.append(text)

    reader = threading.Thread(target=read)
    reader.start()
    for version in range(20):
        render(described, tmp_path / "page", live=Live(version=version, every=1.0, going=True))
    over.set()
    reader.join()
    assert broken == []
    assert not list((tmp_path / "page").glob(".*"))


def make(folder: Path) -> Path:
    (folder / "figures").mkdir(parents=True)
    return folder


def test_a_film_that_cannot_be_written_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_frames: object, path: Path, _fps: float) -> None:
        path.write_bytes(b"half of it")
        raise OSError("no space left")

    frames = [torch.zeros(8, 8, 3, dtype=torch.uint8)]
    write_video(frames, tmp_path / "film.gif")
    before = (tmp_path / "film.gif").read_bytes()
    monkeypatch.setitem(video._WRITERS, ".gif", fail)
    with pytest.raises(OSError, match="no space left"):
        write_video(frames, tmp_path / "film.gif")
    assert (tmp_path / "film.gif").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["film.gif"]


# Following


@pytest.fixture
def naps(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[object]]:
    """What happens while the follower sleeps, one after the other."""
    events: list[object] = []

    def sleep(_seconds: float) -> None:
        event = events.pop(0)
        if isinstance(event, BaseException):
            raise event
        assert callable(event)
        event()

    monkeypatch.setattr(following.time, "sleep", sleep)
    yield events
    assert events == []


def state_of(out: Path) -> tuple[int, bool]:
    """The version of a page, which must be the one that is announced, and whether it looks for newer ones."""
    page = (out / "index.html").read_text()
    version, going = re.findall(r"const own = (\d+), going = (\w+),", page)[0]
    newest = json.loads(re.findall(r"torchrlHer\((.*)\)", (out / "live.js").read_text())[0])
    assert newest["version"] == int(version)
    assert abs(newest["looked"] - time.time()) < 60
    return int(version), going == "true"


def test_a_page_is_renewed_until_the_run_has_ended(tmp_path: Path, naps: list[object]) -> None:
    home, seen, said = write_epochs(tmp_path, 1), [], []

    def look(*, then: object = None) -> None:
        seen.append(state_of(tmp_path / "page"))
        if callable(then):
            then()

    naps += [
        functools.partial(look, then=lambda: None),  # nothing new: the page stays as it is
        functools.partial(look, then=functools.partial(write_epochs, tmp_path, 2)),
        functools.partial(look, then=lambda: (home / "metrics.csv").unlink()),  # it is replaced just now
        functools.partial(look, then=functools.partial(write_epochs, tmp_path, 3, done=True)),
    ]
    page = follow(Followed.runs([home]), tmp_path / "page", say=said.append, film=False)
    assert seen == [(1, True), (1, True), (2, True), (3, True)]
    assert state_of(tmp_path / "page") == (4, False)
    assert said == [str(page)] == [str(tmp_path / "page" / "index.html")]
    assert "Training has ended." in text_of(page.read_text())


def test_ctrl_c_ends_it_and_leaves_a_page_that_renews_itself_no_more(
    tmp_path: Path, naps: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    home = write_epochs(tmp_path, 1)
    naps += [lambda: None, KeyboardInterrupt()]
    assert main(["report", str(home), "--follow", "--no-film"]) == 0
    assert capsys.readouterr().out == f"{home}/report/index.html\n"
    assert state_of(home / "report") == (2, False)
    assert "Nobody follows this training any more: the state of 20" in text_of(
        (home / "report" / "index.html").read_text()
    )


def test_a_study_is_followed_from_before_its_first_run_on(tmp_path: Path, naps: list[object]) -> None:
    runs, texts = tmp_path / "runs", []
    labels = [label for label, _ in STUDY.cells()]

    def write(*wanted: str) -> None:
        texts.append(text_of((tmp_path / "page" / "index.html").read_text()))
        for label in wanted:
            write_run(runs, STUDY, label, [0.5] * 4)

    naps += [functools.partial(write, labels[0]), functools.partial(write, *labels[1:])]
    page = follow(Followed.study(STUDY, runs), tmp_path / "page")
    assert "Nothing has been evaluated yet." in texts[0]
    assert "3 of 4 combinations are missing or not at their end." in texts[1]
    assert "All 4 combinations are at their end." in text_of(page.read_text())


def test_what_stays_unreadable_is_an_error(tmp_path: Path, naps: list[object]) -> None:
    home = write_epochs(tmp_path, 1)
    naps += [lambda: (home / "config.yaml").write_text("task: {name: nothing}")]
    naps += [lambda: (home / "metrics.csv").touch()] * 5
    with pytest.raises(ValueError, match="cannot be read"):
        follow(Followed.runs([home]), tmp_path / "page", film=False)
    with pytest.raises(ValueError, match="every must be above 0, got 0"):
        follow(Followed.runs([home]), tmp_path / "page", every=0)


# In a browser


class Pages(http.server.SimpleHTTPRequestHandler):
    """Gives what is there, and writes the next version of the page when the first one looks for it."""

    asked: list[str]
    then: object

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        self.asked.append(path)
        if path == "/live.js" and callable(self.then) and self.asked.count(path) == 1:
            self.then()  # before the answer, for which the browser's own time stands still
        super().do_GET()

    def log_message(self, *_: object) -> None:
        pass


def dump(address: str, folder: Path, *, milliseconds: int) -> str:
    """What a browser makes of a page after so much of its own time."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    command = [str(BROWSER), *options, f"--virtual-time-budget={milliseconds}", "--dump-dom", address]
    return subprocess.run(command, capture_output=True, text=True, timeout=40, check=True).stdout


@pytest.mark.skipif(BROWSER is None, reason="needs a browser: chromium or google-chrome")
def test_a_browser_loads_the_next_version_keeps_its_place_and_then_stops(tmp_path: Path) -> None:
    home, out = write_epochs(tmp_path, 1), make(tmp_path / "page")
    first = describe(read_runs([home]), out)
    write_epochs(tmp_path, 3, done=True)
    last = describe(read_runs([home]), out)
    scroll = "<script>scrollTo(0, 321)</script></body>"
    look = "<script>addEventListener('load', () => { document.title = `at ${scrollY}`; })</script></body>"

    def show(described: dict[str, Any], version: int, *, going: bool, script: str) -> None:
        page = render(described, out, live=Live(version=version, every=1.0, going=going))
        page.write_text(page.read_text().replace("</body>", script))
        _tell(out, version)

    def visit() -> tuple[str, list[str]]:
        """What the browser ends with, and what it asked for."""
        show(first, 1, going=True, script=scroll)
        renew = staticmethod(functools.partial(show, last, 2, going=False, script=look))
        handler = type("Own", (Pages,), {"asked": [], "then": renew})
        with http.server.ThreadingHTTPServer(
            ("127.0.0.1", 0), functools.partial(handler, directory=str(out))
        ) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            try:
                address = f"http://127.0.0.1:{server.server_port}/index.html"
                return dump(address, tmp_path, milliseconds=8_000), handler.asked
            finally:
                server.shutdown()

    for _ in range(3):  # now and then a browser whose time is not the clock's stands still for good
        with suppress(subprocess.TimeoutExpired):
            dom, asked = visit()
            break
    else:
        pytest.fail("the browser never came to an end")
    assert "<title>at 321</title>" in dom
    assert "Training has ended." in dom
    assert "epoch 3 of 3" in dom
    assert asked.count("/index.html") == 2
    assert asked.count("/live.js") == 1  # the last version does not look any more


@pytest.mark.skipif(BROWSER is None, reason="needs a browser: chromium or google-chrome")
def test_a_browser_says_when_nobody_writes_the_page_any_more(tmp_path: Path) -> None:
    out = make(tmp_path / "page")
    described = describe(read_runs([write_epochs(tmp_path, 1)]), out)
    page = render(described, out, live=Live(version=1, every=1.0, going=True))
    _tell(out, 1)
    dom = dump(page.as_uri(), tmp_path, milliseconds=3_000)  # a file needs no server
    assert 'data-state="going"' in dom
    assert dom.count("<script") == 1  # those that looked are gone
    (out / "live.js").unlink()
    dom = dump(page.as_uri(), tmp_path, milliseconds=90_000)
    assert 'data-state="silent"' in dom
    assert "Nobody writes this page any more" in dom
