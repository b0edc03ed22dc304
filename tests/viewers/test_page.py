import json
import time
import urllib.error
import urllib.request
from dataclasses import replace

import numpy as np
import pytest

from tiptrace.errors import ConfigError, OutputError
from tiptrace.snapshot import FingerView, Snapshot
from tiptrace.types import Event, Phase, Status, TipEstimate
from tiptrace.viewers.live import parse_address, watch_live
from tiptrace.viewers.page import PageServer, host_is_ours
from tiptrace.viewers.page_data import ellipse, state

from .browser import CHROMIUM, Browser

T0 = 1_700_000_000_000_000_000
COVARIANCE = np.diag([4e-8, 1e-8, 9e-8])


def snapshot(k: int = 0, **changes) -> Snapshot:
    """A tip that moves along x by 1 mm per pair."""
    image = np.full((24, 32, 3), 120, np.uint8)
    uv = np.array([[4.0, 5.0], [20.0, 10.0], [np.nan, np.nan]])
    finger = FingerView(image, uv + [1.0, 0.0], uv)
    estimate = TipEstimate(
        T0 + 40_000_000 * k,
        Phase.RECONSTRUCTION,
        Status.OK,
        np.array([0.4 + 0.001 * k, -0.1, 0.02]),
        np.eye(3),
        COVARIANCE,
        2e-5,
        48,
        12.5,
    )
    return replace(Snapshot(estimate, finger, finger, np.eye(4), 24.9, 11.0), **changes)


@pytest.fixture
def page():
    with PageServer(port=0, title="trial") as server:
        yield server


def get(url: str, host: str | None = None):
    request = urllib.request.Request(url, headers={"Host": host} if host else {})
    return urllib.request.urlopen(request, timeout=10)


def first_message(page: PageServer) -> dict:
    with get(page.url + "stream") as answer:
        line = answer.readline().decode()
    assert line.startswith("data: ")
    return json.loads(line[6:])


def test_a_browser_that_comes_late_is_sent_the_whole_trajectory_in_mm(page):
    for k in range(5):
        page.show(snapshot(k))
    message = first_message(page)
    assert message["title"] == "trial"
    assert [row[:2] for row in message["path"]] == [[pytest.approx(0.04 * k), 400.0 + k] for k in range(5)]
    assert message["sigma"] == pytest.approx([0.2, 0.1, 0.3])
    assert message["status"] == "ok"
    assert message["left"]["arrows"] == [[4.0, 5.0, 5.0, 5.0], [20.0, 10.0, 21.0, 10.0]]


def test_then_only_what_is_new(page):
    page.show(snapshot(0))
    with get(page.url + "stream") as answer:
        answer.readline()
        page.show(snapshot(1))
        line = b""
        while not line.startswith(b"data: "):
            line = answer.readline()
    assert [row[1] for row in json.loads(line[6:])["path"]] == [401.0]


def test_no_position_is_sent_as_none_and_never_as_the_last_one(page):
    page.show(snapshot(0))
    lost = TipEstimate(T0 + 1, Phase.RECONSTRUCTION, Status.LOST)
    page.show(Snapshot(lost))
    message = first_message(page)
    assert message["p"] is None
    assert message["ellipse"] is None
    assert message["path"][-1][1:] == [None, None, None, None, None, None, "lost"]


def test_numbers_that_are_none_do_not_break_the_message():
    estimate = replace(snapshot().estimate, covariance=np.full((3, 3), np.nan), residual_m=float("nan"))
    message = state(Snapshot(estimate, rate_hz=float("inf")), T0)
    json.dumps(message, allow_nan=False)
    assert message["sigma"] is None
    assert message["residual"] is None


def test_ellipse_has_the_covariance_s_axes():
    angle = 0.4
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = R @ np.diag([9e-6, 1e-6]) @ R.T
    a, b, found = ellipse(Snapshot(replace(snapshot().estimate, covariance=covariance)))
    assert (a, b) == pytest.approx((3.0, 1.0))
    assert np.tan(found) == pytest.approx(np.tan(angle))


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8321", "127.0.0.1.evil.example", ""])
def test_other_hosts_names_are_refused(page, host):
    """A page elsewhere whose name is made to point here must not read what is served."""
    for path in ("", "stream"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            get(page.url + path, host or "x")
        assert refused.value.code == 421


def test_own_names_pass():
    for header in ("127.0.0.1:80", "localhost", "LOCALHOST:8321", "[::1]:8321"):
        assert host_is_ours(header, "127.0.0.1")
    assert host_is_ours("192.168.1.7:8321", "0.0.0.0")
    assert not host_is_ours("192.168.1.7:8321", "127.0.0.1")
    assert not host_is_ours("evil.example", "0.0.0.0")


def test_listens_on_this_machine_only_and_allows_no_foreign_content(page):
    assert page.url.startswith("http://127.0.0.1:")
    with get(page.url) as answer:
        policy, text = answer.headers["content-security-policy"], answer.read().decode()
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in text.replace("http-equiv", "")
    assert "NONCE" not in text


def test_a_taken_port_is_told(page):
    port = int(page.url.rsplit(":", 1)[1].strip("/"))
    with pytest.raises(OutputError, match="cannot listen"), PageServer(port=port):
        pass


def test_showing_takes_no_time_whoever_watches(page):
    with get(page.url + "stream"):
        start = time.perf_counter()
        for k in range(200):
            page.show(snapshot(k))
        assert time.perf_counter() - start < 1.0


def test_addresses():
    assert parse_address("") == ("127.0.0.1", 8321)
    assert parse_address("9000") == ("127.0.0.1", 9000)
    assert parse_address("0.0.0.0:80") == ("0.0.0.0", 80)
    assert parse_address("[::1]:80") == ("::1", 80)
    for text in ("here:there", ":²", "::1", "1:2:3", "127.0.0.1:99999"):
        with pytest.raises(ConfigError, match="HOST:PORT"):
            parse_address(text)
    with pytest.raises(OutputError, match="cannot listen"), PageServer("no..name"):
        pass


class Session:
    """Something that can be watched."""

    def __init__(self) -> None:
        self.subscribers = []

    def subscribe(self, subscriber):
        self.subscribers.append(subscriber)
        return lambda: self.subscribers.remove(subscriber)


def test_a_live_session_is_watched_while_the_block_runs():
    session = Session()
    with watch_live(session, serve="127.0.0.1:0") as told:
        session.subscribers[0](snapshot(0))
        with get(told.removeprefix("page: ").strip() + "stream") as answer:
            assert b'"ok"' in answer.readline()
    assert not session.subscribers


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_page_draws_and_runs_nothing_that_it_is_shown(tmp_path):
    """Names and details come from recordings: they appear as text."""
    evil = "<img src=x onerror=document.title='pwned'><script>document.title='pwned'</script>"
    with PageServer(port=0, title=evil) as page:
        for k in range(30):
            event = Event("grasp-slip", T0, T0 + 1, evil)
            page.show(snapshot(k, events=(event,), advice=evil, notes=(evil,)))
        with Browser(page.url, (1200, 800)) as browser:
            browser.wait_for("document.body?.dataset.rows === '30'")
            assert browser.evaluate("document.getElementById('events').textContent.includes('<script>')")
            assert (
                browser.evaluate("document.querySelectorAll('img, main script, header script').length") == 0
            )
            assert browser.evaluate("document.title") == evil + " – tiptrace"
            assert browser.evaluate("document.getElementById('x').textContent") == "429.00"
            assert browser.evaluate("document.getElementById('status').textContent") == "ok"
            ink = (
                "(() => { const c = document.getElementById('top'), d = c.getContext('2d')"
                ".getImageData(0, 0, c.width, c.height).data; let n = 0;"
                "for (let k = 0; k < d.length; k += 4) if (d[k] < 40 && d[k + 2] > 150 && d[k + 3]) n++; return n; })()"
            )
            assert browser.evaluate(ink) > 500  # the trajectory's blue
            browser.screenshot(tmp_path / "page.png")
    assert (tmp_path / "page.png").stat().st_size > 10_000
