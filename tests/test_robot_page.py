"""The live page: what it shows, who may change what, and that to show a tick takes no time."""
import http.client
import json
import signal
import socket
import threading
import time

import cv2
import numpy as np
import pytest
from robot_arms import Driver, mistakes, placed

from common.robot import page, safety, views

ROW = dict(image=np.full((480, 640, 3), 128, np.uint8), corners=np.zeros((0, 4, 2)), age=0, covered=False,
           true=np.zeros(3), seen=np.zeros(3), estimated=np.array([0.01, 0.0, 0.1]), sigma=np.full(4, 0.05),
           pusher=np.array([-0.1, 0.0]), force=np.array([5.0, 0.0]), points=placed().points)


@pytest.fixture(scope="module")
def served():
    with page.Page(0) as screen:
        yield screen


@pytest.fixture
def screen(served):
    """A page with nothing on it yet, and an arm that nobody has touched."""
    served.begin("")
    served.jpeg, served.arm = b"", safety.Guarded(placed())
    return served


def ask(screen, method, path, origin="http://127.0.0.1:{}", host="127.0.0.1:{}"):
    """Status, body and the state of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", screen.server_port, timeout=5)
    connection.putrequest(method, path, skip_host=True)
    for name, value in (("Host", host), ("Origin", origin)):
        if value:
            connection.putheader(name, value.format(screen.server_port))
    connection.endheaders()
    reply = connection.getresponse()
    return reply.status, reply.read(), json.loads(reply.headers["State"] or "null")


def until(happens, seconds=5):
    end = time.monotonic() + seconds
    while not happens() and time.monotonic() < end:
        time.sleep(0.01)
    return happens()


def test_the_page_shows_the_newest_tick_and_the_guards_state(screen):
    assert b"/frame" in ask(screen, "GET", "/")[1] and ask(screen, "GET", "/frame")[1] == b""
    screen.begin("natural, run 3")
    for tick in range(20):
        screen.show(ROW, tick)
    assert until(lambda: screen.jpeg)
    status, body, state = ask(screen, "GET", "/frame")
    assert status == 200 and cv2.imdecode(np.frombuffer(body, np.uint8), 1).shape == (600, 960, 3)
    assert state == "natural, run 3: the guard is content"
    screen.arm.halt("joint 3\nis é")
    assert ask(screen, "GET", "/frame")[2] == "natural, run 3: arm stopped: joint 3\nis é"


def test_a_run_that_begins_amid_a_picture_is_shown_too(screen):
    for run in range(20):
        screen.show(ROW, 0)
        screen.begin(f"run {run}")
        time.sleep(0.005)
    screen.jpeg = b""
    screen.show(ROW, 0)
    assert until(lambda: screen.jpeg) and all(thread.is_alive() for thread in screen.threads)


def test_the_composite_has_its_panels_and_curves():
    plain, high = (views.composite(ROW, 3, [(force, 5.0, 0.0)] * 150) for force in (1.0, 14.0))
    assert plain.shape == (600, views.WIDTH, 3) and (plain[:360] == high[:360]).all()
    curve = [np.argwhere((image[360:440, 700] == views.film.ESTIMATE).all(1)).mean() for image in (plain, high)]
    assert curve[0] > curve[1] + 40 and (plain[380:430, 740:] == 255).all()  # the run is half over


@pytest.mark.parametrize("origin, host", [
    (None, "127.0.0.1:{}"), ("null", "127.0.0.1:{}"), ("http://evil.example", "127.0.0.1:{}"), ("http://127.0.0.1:{}", None),
    ("http://evil.example:{}", "evil.example:{}"), ("http://localhost:{}", "127.0.0.1:{}"),
    ("https://127.0.0.1:{}", "127.0.0.1:{}")])
def test_only_the_page_itself_may_change_anything(screen, origin, host):
    for path in ("/stop", "/cover", "/nudge/0.01/0", "/next"):
        assert ask(screen, "POST", path, origin, host)[0] == 403
        assert ask(screen, "GET", path)[::2] == (404, None)
    assert not screen.arm.stopped and not screen.arm.arm.joined
    assert ask(screen, "POST", "/stop")[0] == 204 and screen.arm.stopped == "arm stopped: the page's stop button"
    assert not screen.arm.arm.joined


def test_nothing_is_shown_to_a_page_that_calls_itself_otherwise(screen):
    assert ask(screen, "GET", "/frame", host="evil.example:{}")[0] == 404


def test_one_can_join_in_with_the_simulated_arm(screen):
    arm = screen.arm.arm
    assert ask(screen, "POST", "/cover")[0] == 204 and arm.covered and arm.joined
    assert "joined, not counted" in ask(screen, "GET", "/frame")[2]
    assert until(lambda: not arm.covered, 1)  # where the tab was closed under the hand
    before = arm.box.copy()
    assert ask(screen, "POST", "/nudge/0.0100/-0.0200")[0] == 204
    arm.command(np.zeros(7))
    assert np.allclose(arm.box - before, [0.01, -0.02, 0.0])
    ask(screen, "POST", "/nudge/-0.09/0.02")  # onto the pusher
    arm.command(np.zeros(7))
    assert np.allclose(arm.box - before, [0.01, -0.02, 0.0])
    assert ask(screen, "POST", "/next")[0] == 204 and arm.ended


def test_a_real_arm_can_only_be_stopped(screen):
    screen.arm = safety.Guarded(Driver(None))
    assert b"<span hidden>" in ask(screen, "GET", "/")[1]
    assert not any(ask(screen, "POST", path)[0] == 500 for path in ("/cover", "/next", "/nudge/0.01/0.0"))
    assert not screen.arm.arm.simulated.joined and not screen.arm.stopped
    ask(screen, "POST", "/stop")
    assert screen.arm.arm.simulated.stopped


@pytest.mark.parametrize("path", ["/nudge", "/nudge/1", "/nudge/nan/0", "/nudge/inf/0", "/nudge/9/9", "/nudge/a/b",
                                  "/nudge/0/0/0", "/stop/1", "/", "/frame", "//", "/sto", "/../stop", "/%73top",
                                  "/" + "x" * 3000])
def test_garbage_is_refused(screen, path):
    assert ask(screen, "POST", path)[0] == 404 and not screen.arm.stopped and not screen.arm.arm.nudges


def test_the_page_survives_garbage_and_closed_tabs(screen, capsys):
    held = [socket.create_connection(("127.0.0.1", screen.server_port)) for _ in range(50)]  # they say nothing
    rng = np.random.default_rng(0)
    for words in [b"", b"\r\n\r\n", b"GET", b"POST /stop HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n",
                  b"GET /frame HTTP/1.1\r\n", b"GET / HTTP/9.9\r\n\r\n", b"X" * 100_000, *(rng.bytes(1000) for _ in range(20))]:
        with socket.create_connection(("127.0.0.1", screen.server_port)) as visitor:
            visitor.sendall(words)
            visitor.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # closed as by a kill
    assert ask(screen, "GET", "/")[0] == 200 and not screen.arm.stopped
    for connection in held:
        connection.close()
    assert not capsys.readouterr().err


def test_the_stop_button_works_with_five_tabs_open(screen):
    screen.show(ROW, 0)
    open_tabs, asked = threading.Event(), []

    def tab():
        while not open_tabs.is_set():
            asked.append(ask(screen, "GET", "/frame")[0])
            time.sleep(0.06)

    tabs = [threading.Thread(target=tab) for _ in range(5)]
    for thread in tabs:
        thread.start()
    until(lambda: len(asked) > 20)
    began = time.monotonic()
    ask(screen, "POST", "/stop")
    took = time.monotonic() - began
    open_tabs.set()
    for thread in tabs:
        thread.join()
    assert took < 0.2 and screen.arm.stopped and screen.arm.arm.stopped and set(asked) == {200}


def test_a_painter_that_stands_still_delays_no_tick_and_paints_the_newest_next(screen):
    screen.show(ROW, 0)
    assert until(lambda: screen.jpeg)
    screen.painter.send_signal(signal.SIGSTOP)
    began = time.perf_counter()
    for tick in range(1, 50):
        screen.show(ROW, tick)
    spent = time.perf_counter() - began
    screen.painter.send_signal(signal.SIGCONT)
    due = cv2.imencode(".jpg", views.composite(ROW, 49, list(screen.history))[..., ::-1])[1].tobytes()
    assert spent < 0.5 and until(lambda: screen.jpeg == due)


def test_the_page_outlives_its_painter():
    with page.Page(0) as screen:
        screen.arm = safety.Guarded(placed())
        screen.show(ROW, 0)
        assert until(lambda: screen.jpeg)
        screen.painter.kill()
        for tick in range(3):
            screen.show(ROW, tick)
            time.sleep(0.05)
        assert ask(screen, "GET", "/frame")[:2] == (200, screen.jpeg) and ask(screen, "POST", "/stop")[0] == 204


@pytest.mark.parametrize("words", ["taken", "70000"])
def test_a_port_that_cannot_be_had_is_one_line(robot, screen, words):
    port = str(screen.server_port) if words == "taken" else words
    _, stderr, code, _ = robot("--view", port)
    assert code == 2 and len(mistakes(stderr)) == 1 and f"--view {port}: this port cannot be had" in stderr
    assert robot("--view", "8123", "8124")[2] == 2


def test_a_run_that_somebody_joined_is_not_counted_and_the_page_ends_with_the_program(robot, monkeypatch):
    made, seen = [], []
    begin = page.Page.begin

    def joining(screen, title):
        begin(screen, title)
        made.append(screen)
        if "run 1" in title:
            screen.arm.arm.join("nudge", np.array([0.0, 0.01]))

    def watch():
        until(lambda: made and made[0].jpeg, 60)
        seen.append(ask(made[0], "GET", "/frame"))

    monkeypatch.setattr(page.Page, "begin", joining)
    monkeypatch.setattr(page.Page.__init__, "__defaults__", (0,))
    visitor = threading.Thread(target=watch)
    visitor.start()
    stdout, _, code, folder = robot("--scenario", "natural", "--runs", "2", "--view")
    visitor.join()
    row = json.loads((folder / "summary.json").read_text())["natural"]
    logs = [np.load(folder / f"natural_{k:03d}.npz") for k in range(2)]
    assert code == 0 and row["runs"] == row["joined"] == 1 and "1 joined" in stdout
    assert [bool(log["joined"]) for log in logs] == [True, False]
    assert seen[0][0] == 200 and f"see http://127.0.0.1:{made[0].server_port}" in stdout
    with pytest.raises(ConnectionRefusedError):
        ask(made[0], "GET", "/")


def test_the_next_run_begins_when_it_is_asked_for(robot, monkeypatch):
    show = page.Page.show

    def impatient(screen, row, tick):
        show(screen, row, tick)
        if tick == 5:
            screen.act("next")

    monkeypatch.setattr(page.Page, "show", impatient)
    monkeypatch.setattr(page.Page.__init__, "__defaults__", (0,))
    _, _, code, folder = robot("--scenario", "natural", "--runs", "2", "--view")
    logs = [np.load(folder / f"natural_{k:03d}.npz") for k in range(2)]
    assert code == 0 and all(str(log["ended"]) == "ended on the page" and log["joined"] for log in logs)
    assert [len(log["time"]) for log in logs] == [6, 6]
