"""Who may look at a page, and the words and figures that it shows; no browser."""

import math
import socket

import numpy as np
import pytest

from lab.base.errors import RequestError
from lab.cli.main import main
from lab.live import charts, words
from lab.live.folder import Sightings, StoryFolder
from lab.live.map import arena_svg
from lab.live.page.guard import Guard
from lab.live.server import check_nicegui, listen


async def inner(scope, receive, send):
    from starlette.responses import PlainTextResponse

    await PlainTextResponse("inside")(scope, receive, send)


def asked(guard, path="/", headers=(), kind="http"):
    """The status of one request, by ASGI itself; 1008 and 101 for a WebSocket refused and let through."""
    import asyncio

    path, _, query = path.partition("?")
    scope = {
        "type": kind, "path": path, "query_string": query.encode(), "method": "GET", "scheme": "http",
        "headers": [(name.lower().encode(), value.encode()) for name, value in headers],
    }  # fmt: skip
    sent = []

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": f"{kind}.connect"}

    asyncio.run(guard(scope, receive, send))
    return sent[0]


def status(*args, **kwargs):
    return asked(*args, **kwargs).get("status")


LOCAL = Guard(inner, host="127.0.0.1", port=80, token="")
OPEN = Guard(inner, host="0.0.0.0", port=80, token="s3cret")


@pytest.mark.parametrize("host", ["127.0.0.1:80", "localhost:80", "LOCALHOST", "[::1]:80"])
def test_this_machine_by_its_own_names(host):
    assert status(LOCAL, headers=[("Host", host)]) == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "192.168.1.7:80", "", "[", "a:b:c"]
)
def test_another_name_that_leads_here_is_refused(host):
    assert status(LOCAL, headers=[("Host", host)]) == 421
    assert status(LOCAL) == 421
    assert asked(LOCAL, headers=[("Host", host)], kind="websocket")["type"] == "websocket.close"


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:81", "http://localhost:80"])
def test_another_sites_page_may_not_ask(origin):
    headers = [("Host", "127.0.0.1:80"), ("Origin", origin)]
    assert status(LOCAL, headers=headers) == 403
    assert asked(LOCAL, headers=headers, kind="websocket")["type"] == "websocket.close"
    assert status(LOCAL, headers=[("Host", "127.0.0.1:80"), ("Origin", "http://127.0.0.1:80")]) == 200


def test_beyond_this_machine_a_token_is_needed():
    name = socket.gethostname()
    for host in ("192.168.1.7:80", f"{name}:80", "[fe80::1]:80"):
        bare = [("Host", host)]
        assert status(OPEN, headers=bare) == 401
        assert status(OPEN, "/?token=", headers=bare) == 401
        assert status(OPEN, "/?token=s3cre", headers=bare) == 401
        assert status(OPEN, "/?token=%C3%A9", headers=bare) == 401
        answer = asked(OPEN, "/?token=s3cret&large=1", headers=bare)
        assert answer["status"] == 303
        told = dict(answer["headers"])
        assert told[b"location"] == b"/?large=1"
        cookie = told[b"set-cookie"].decode()
        assert "SameSite=strict" in cookie
        assert "HttpOnly" in cookie
        shown = [*bare, ("Cookie", cookie.partition(";")[0])]
        assert status(OPEN, headers=shown) == 200
        assert status(OPEN, headers=[*bare, ("Cookie", "chordlab-80=no")]) == 401
        assert asked(OPEN, headers=bare, kind="websocket")["type"] == "websocket.close"
    assert status(OPEN, "/?token=s3cret", headers=[("Host", "evil.example")]) == 421


def test_a_token_is_made_where_others_reach_the_page():
    everywhere, here, chosen = listen("0.0.0.0"), listen(), listen("127.0.0.1", token="mine")
    try:
        assert len(everywhere.token) >= 24
        assert everywhere.url.endswith(f"/?token={everywhere.token}")
        assert here.token == ""
        assert here.url == f"http://127.0.0.1:{here.bound.getsockname()[1]}/"
        assert chosen.url.endswith("?token=mine")
        with pytest.raises(RequestError, match="choose another --port"):
            listen("127.0.0.1", here.bound.getsockname()[1])
    finally:
        for address in (everywhere, here, chosen):
            address.bound.close()


def test_without_nicegui_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(RequestError, match=r"pip install 'chordlab\[live\]'"):
        check_nicegui()


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["run", "--simulate", "--speed", "0"], "--speed"),
        (["run", "--simulate", "--port", "8080"], "--live"),
        (["run", "--simulate", "--live", "--host", "256.1.1.1"], "--port"),
        (["run", "--letters", "--simulate", "--shape", "text:AB", "--shape", "text:C"], "--shape once"),
        (["watch", "nowhere"], "manifest.json"),
    ],
)
def test_a_wrong_request_is_one_line(argv, says, capsys):
    assert main(argv) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert says in lines[0]


def test_several_shapes_are_a_session_each(tmp_path, capsys):
    import json

    argv = ["run", "--simulate", "--no-video", "--lines", "4", "--seed", "1", "--out", str(tmp_path), "--json"]
    assert main([*argv, "--shape", "square", "--shape", "circle"]) == 0
    sessions = json.loads(capsys.readouterr().out)["sessions"]
    assert [session["lines"] for session in sessions] == [4, 4]
    assert len(list(tmp_path.iterdir())) == 2


def test_charts_of_nothing_and_of_little_are_drawn(square_session):
    folder = StoryFolder(square_session.folder)
    folder.read()
    truth = (folder.truth.area_cm2, folder.truth.perimeter_cm)
    for t_s in (-1.0, *(standing.t_s for standing in folder.story.standings[:4]), math.inf):
        moment = folder.story.at(t_s)
        for ink in (charts.LIGHT, charts.DARK):
            drawn = [
                charts.convergence(moment.standings, "area_cm2", truth[0], "cm²", ink),
                charts.plane(moment.standings, truth, ink),
                charts.names(moment.last, ink),
                charts.runs(moment.runs, ink),
                charts.light_strip({}, ink),
                charts.light_strip({"a": [(1.0, 20.0), (1.05, 119.5)], "b": []}, ink),
            ]
            assert all(len(options["series"]) == len(options["series"]) for options in drawn)
            numbers = [point for options in drawn for series in options["series"] for point in series["data"]]
            assert not any(
                isinstance(x, float) and not math.isfinite(x) for p in numbers if isinstance(p, list) for x in p
            )
    series = len(charts.plane(folder.story.standings, truth, charts.LIGHT)["series"])
    assert len(charts.plane([], truth, charts.LIGHT)["series"]) == series  # ECharts merges by place


def test_the_last_ellipse_is_the_smallest_and_holds_the_truth(square_session):
    from shapely import Point, Polygon

    folder = StoryFolder(square_session.folder)
    folder.read()
    options = charts.plane(folder.story.standings, (44.0**2, 4 * 44.0), charts.LIGHT)
    rings = [Polygon(s["data"]) for s in options["series"] if s["name"].startswith("ellipse") and s["data"]]
    sizes = [ring.area for ring in rings]
    assert min(sizes) == sizes[-1]
    assert rings[-1].contains(Point(4 * 44.0, 44.0**2))


def test_the_map_draws_what_was_seen():
    from shapely import box

    seen = Sightings(np.arange(3.0), np.array([0.0, 1, 2]), np.array([5.0, 6, 7]), np.array([False, True, True]))
    drawing = arena_svg(box(-60, -45, 60, 45), [np.array([[-5.0, -5], [5, -5], [5, 5]])], seen, label="x")
    assert 'class="way" d="M0.0 -5.0h0"' in drawing
    assert 'class="lit" d="M1.0 -6.0h0M2.0 -7.0h0"' in drawing
    assert 'viewBox="-62 -47 124 94"' in drawing
    assert drawing.count("<circle") == 1
    pair = Sightings(np.array([0.0, 1, 1]), np.zeros(3), np.array([5.0, 6, 7]), np.array([False, True, False]))
    here = arena_svg(box(-60, -45, 60, 45), [], pair, label="x")
    assert [here.count(f'class="here {state}"') for state in ("lit", "dark")] == [1, 1]  # both robots


def test_each_robot_has_a_line_of_its_own_light():
    strip = charts.light_strip({name: [(1.0, 20.0), (2.0, 120.0)] for name in "abc"}, charts.LIGHT)
    assert [series["name"] for series in strip["series"]] == ["a", "b", "c"]
    assert [series["data"] for series in strip["series"]] == [[[-1.0, 20.0], [0.0, 120.0]]] * 3
    assert len({(s["lineStyle"]["type"], s["lineStyle"]["color"]) for s in strip["series"]}) == 3
    assert strip["legend"]["show"]


def test_words():
    assert [words.duration(s) for s in (math.nan, 5, 89.6, 600, 7200)] == ["–", "5 s", "90 s", "10 min", "2.0 h"]
    assert words.with_error(1936.4, 12.2, "cm²") == "1936 ± 12 cm²"
    assert words.with_error(1936.4, math.nan, "cm²") == "1936 cm²"
    assert words.headline(None) == "No line has crossed the shape yet"
