"""A page on this machine: what the robot sees, believes and does, and a stop button; one can join in with the simulated arm."""
import contextlib
import json
import multiprocessing
import os
import subprocess
import sys
import threading
from collections import deque
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import numpy as np

from common import draw
from common.files import UserError
from common.robot import views

BUTTON = "the page's stop button"
HTML = """<!doctype html><meta charset="utf-8"><title>Pushing under occlusion</title>
<style>body { font: 16px sans-serif; max-width: 960px; margin: 1em auto } img { width: 100%; user-select: none }
button { font: inherit; padding: .5em 1em } #stop { background: #c33; color: white }</style>
<b id="state"></b><img id="view" draggable="false" alt="no run yet"><p><button id="stop">Stop the arm</button>
<span JOIN><button id="cover">Hold to cover the tags</button> <button id="next">Next run</button>
or drag the box in the view from above; such a run is not counted.</span>
<script>
const post = path => fetch(path, {method: "POST"}).catch(() => {})
let covering = false, drag = null, way = [0, 0]
async function follow() {
  try {
    const reply = await fetch("/frame"), image = await reply.blob()
    state.textContent = JSON.parse(reply.headers.get("State"))
    if (image.size) { URL.revokeObjectURL(view.src); view.src = URL.createObjectURL(image) }
  } catch { state.textContent = "No answer: the program has ended." }
  setTimeout(follow, 100)
}
document.getElementById("stop").onclick = () => post("/stop")
next.onclick = () => post("/next")
cover.onpointerdown = () => covering = true
view.onpointerdown = event => {
  if (event.offsetX < view.clientWidth / 2 && event.offsetY > view.clientWidth * TOP / WIDTH) drag = event
}
onpointermove = event => {
  const metres = drag ? 2 * VIEW / view.clientWidth : 0
  if (drag) way = [way[0] + (event.clientX - drag.clientX) * metres, way[1] - (event.clientY - drag.clientY) * metres]
  drag = drag && event
}
onpointerup = onblur = () => { covering = false; drag = null }
setInterval(() => {
  if (covering) post("/cover")
  if (way[0] || way[1]) post(`/nudge/${way[0].toFixed(4)}/${way[1].toFixed(4)}`)
  way = [0, 0]
}, 100)
follow()
</script>""".replace("WIDTH", str(views.WIDTH)).replace("TOP", str(views.TOP)).replace("VIEW", str(draw.VIEW))


def paint(pipe):
    """The painter's process: answers each tick, as views.composite takes it, with its JPEG, until the other end is closed."""
    os.nice(10)
    with contextlib.suppress(OSError):  # Linux shares the cores among sessions first, and within each by niceness
        Path("/proc/self/autogroup").write_text("10")
    cv2.setNumThreads(1)
    pipe.send_bytes(b"")  # ready
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(cv2.imencode(".jpg", views.composite(*pipe.recv())[..., ::-1])[1].tobytes())


class Page(ThreadingHTTPServer):
    """Serves the page on the loopback address until the context ends; what is shown is drawn in a process of its own, since a
    thread would keep the interpreter from those that move the arm.

    `arm` is the safety.Guarded that its button stops, None until there is one. UserError where the port cannot be had.
    """

    daemon_threads, request_queue_size, arm, title, jpeg, latest = True, 64, None, "", b"", None

    def __init__(self, port=8006, *more):
        try:
            super().__init__(("127.0.0.1", port, *more), Request)
        except (OSError, OverflowError, TypeError) as error:
            raise UserError(f"--view {port}: this port cannot be had ({error}); give another") from None
        self.fresh, self.history = threading.Event(), deque(maxlen=views.SPAN)
        self.pipe, far = multiprocessing.Pipe()
        self.painter = subprocess.Popen(  # a session of its own: Ctrl-C is for the program alone
            [sys.executable, "-m", "common.robot.page", str(far.fileno())], cwd=Path(__file__).parents[2],
            pass_fds=[far.fileno()], start_new_session=True)
        far.close()
        self.pipe.recv_bytes()
        self.threads = [threading.Thread(target=work, daemon=True) for work in (self.draw, lambda: self.serve_forever(0.1))]
        for thread in self.threads:
            thread.start()

    def __exit__(self, *error):
        self.painter.kill()  # whatever it does: the thread that waits for it ends too
        self.painter.wait()
        self.fresh.set()
        self.shutdown()
        self.server_close()
        for thread in self.threads:
            thread.join(5)
        self.pipe.close()

    def begin(self, title):
        """A run begins."""
        self.title = title
        self.history.clear()

    def show(self, row, tick):
        """A tick of 06_robot.control, to be drawn when there is time, if it is the newest then."""
        self.history.append(views.curves_of(row))
        self.latest = row, tick, list(self.history)
        self.fresh.set()

    def draw(self):
        with contextlib.suppress(EOFError, OSError):  # where the painter has gone the last image stays
            while self.fresh.wait():
                self.fresh.clear()
                self.pipe.send(self.latest)
                self.jpeg = self.pipe.recv_bytes()

    def state(self):
        """The run, and what the guard says."""
        simulated = getattr(self.arm, "simulated", None)
        joined = " (joined, not counted)" if simulated and simulated.joined else ""
        return f"{self.title}{joined}: {getattr(self.arm, 'stopped', '') or 'the guard is content'}"

    def act(self, word, *numbers):
        """What a button asks for; all but the stop is for the simulated arm. ValueError if it is none."""
        way = np.array(numbers, float)
        sizes = {"stop": 0, "cover": 0, "next": 0, "nudge": 2}
        if sizes.get(word) != len(way) or not (np.abs(way) < 0.1).all():  # nan is not
            raise ValueError
        if word == "stop":
            self.arm.halt(BUTTON)
        elif self.arm.simulated:
            self.arm.simulated.join(word, way)

    def handle_error(self, *connection):
        """A tab that was closed is no matter."""


class Request(BaseHTTPRequestHandler):
    timeout = 2  # s that a visitor may keep silent

    def own(self):
        """Whether the page is called by its own name: another may be a stranger's, bent to this machine."""
        return self.headers.get("Host") in [f"{name}:{self.server.server_port}" for name in ("127.0.0.1", "localhost")]

    def do_GET(self):
        join = self.server.arm is None or self.server.arm.simulated
        parts = {"/": (HTML.replace("JOIN", "" if join else "hidden").encode(), "text/html"),
                 "/frame": (self.server.jpeg, "image/jpeg")}
        if not self.own() or self.path not in parts:
            return self.answer(404)
        self.answer(200, *parts[self.path])

    def do_POST(self):
        if not self.own() or self.headers.get("Origin") != f"http://{self.headers['Host']}":
            return self.answer(403)
        try:
            self.server.act(*self.path[1:].split("/"))
            self.answer(204)
        except (ValueError, AttributeError):  # the last where there is no arm yet
            self.answer(404)

    def answer(self, code, body=b"", kind="text/plain"):
        self.send_response(code)
        state = {"State": json.dumps(self.server.state())} if code == 200 else {}
        for name, value in {"Content-Type": kind, "Content-Length": len(body), "Cache-Control": "no-store",
                            "Content-Security-Policy": "frame-ancestors 'none'", **state}.items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *words):
        """Requests are no news."""


if __name__ == "__main__":
    paint(Connection(int(sys.argv[1])))
