"""What the bench page costs: clients and silent sockets, memory, first paint, 10^5 samples.

Absolute times: a person waits for them. Needs the extras web and dev, and a Chromium.
`python perf/page.py load memory paint zoom` measures all; a word alone measures one.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import httpx2 as httpx
from playwright.sync_api import Page, sync_playwright

CLIENTS, SECONDS, SILENT, EXPERIMENTS, SAMPLES = 50, 60.0, 500, 1000, 100_000
EXPERIMENT = {
    "plant": "aero2", "excitation": "chirp", "amplitude": 7.2, "noise": {}, "params": {},
    "steps": 50, "seed": 0, "others": [], "seconds": 0,
}  # fmt: skip
ZOOM = """async (count) => {
  const { Plot } = await import("/static/plot.js"), times = [], second = (k) => k / 1000;
  const x = Array.from({ length: count }, (_, k) => second(k)), all = [0, second(count)];
  const wave = (f) => x.map((t, k) => Math.sin(f * t) + 0.1 * Math.sin(k * k));
  const parent = document.createElement("div"); // a view of its own, like that of a record
  parent.className = "own plots";
  document.querySelector("#signals").replaceChildren(parent);
  const measured = { x, y: wave(3), name: "measured", color: "output", points: true };
  const simulated = { x, y: wave(3.1), name: "simulated", color: "simulated" };
  const views = [[{ x, y: wave(3), color: "input", step: true }], [measured, simulated],
    [{ x, y: wave(0), color: "output" }]];
  const plots = views.map((lines) => {
    const plot = new Plot(parent, "many", "many samples");
    plot.show({ x: all, y: [-2, 2], unit: "s", lines });
    return plot;
  });
  const ends = plots.map((plot) => () => plot.u.ctx.getImageData(0, 0, 1, 1));
  await new Promise((done) => setTimeout(done, 2000));
  for (let i = 0; i <= 20; i++) {
    const begin = performance.now();
    plots[0].group.show(i % 5 ? [i * all[1] / 100, (95 - 4 * i) * all[1] / 100] : null);
    await null; // uPlot draws in a microtask
    const script = performance.now() - begin;
    ends.forEach((end) => end()); // waits for the pixels
    if (i) times.push([script, performance.now() - begin]);
    await new Promise((done) => setTimeout(done, 100));
  }
  return times;
}"""


@contextlib.contextmanager
def served() -> Iterator[tuple[str, int]]:
    """The address of a page that shows the results of this repository, and its process."""
    runs = Path(__file__).parents[1] / "results"
    words = [sys.executable, "-m", "excite", "serve", "--port", "0", "--json", "--runs", str(runs)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        told = b"".join(iter(server.stdout.readline, b"}\n")) + b"}"
        yield json.loads(told)["address"].rstrip("/"), server.pid
        server.terminate()


@contextlib.contextmanager
def client(address: str) -> Iterator[httpx.Client]:
    """A browser with a session."""
    with httpx.Client(base_url=address, headers={"origin": address}, timeout=120) as one:
        one.post("/api/session", json={})
        yield one


def experiment(one: httpx.Client, seed: int) -> None:
    """One experiment with its identification."""
    answer = one.post("/api/experiments", json={**EXPERIMENT, "seed": seed})
    assert '"kind": "end"' in answer.text, answer.text[-300:]


def use(address: str) -> None:
    """50 clients until a minute is over, ten of them with experiments."""
    end = time.monotonic() + SECONDS

    def one_client(i: int) -> None:
        with client(address) as one:
            while time.monotonic() < end:
                for place in ("/", "/static/bench.js", "/api/runs"):
                    assert one.get(place).status_code == 200
                if i < 10:
                    one.post("/api/experiments", json={**EXPERIMENT, "seed": i})
                time.sleep(1.0)  # a person reads

    threads = [threading.Thread(target=one_client, args=(i,)) for i in range(CLIENTS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def load(address: str) -> None:
    """How fast a stranger gets the page while it is used, and 500 sockets say nothing."""
    parts, taken = urlsplit(address), list[float]()
    with contextlib.ExitStack() as opened:
        for i in range(SILENT):
            one = opened.enter_context(socket.create_connection((parts.hostname, parts.port)))
            if i % 2:
                one.sendall(b"GET / HTTP/1.1\r\nHost: ")
        using = multiprocessing.get_context("spawn").Process(target=use, args=(address,))
        using.start()
        while using.is_alive():
            begin = time.perf_counter()
            with contextlib.closing(HTTPConnection(parts.netloc, timeout=60)) as one:
                one.request("GET", "/")
                assert one.getresponse().read()
            taken.append(time.perf_counter() - begin)
            time.sleep(0.2)
        assert not using.exitcode
    middle, rare = statistics.median(taken), statistics.quantiles(taken, n=100)[-1]
    print(f"load: {CLIENTS} clients, {SILENT} silent sockets; the page answers in "
          f"{1e3 * middle:.0f} ms (median), {1e3 * rare:.0f} ms (99 %), {1e3 * max(taken):.0f} ms "
          f"(longest of {len(taken)}, after {taken.index(max(taken))} others)")  # fmt: skip


def memory(address: str, process: int) -> None:
    """Memory of the server over a thousand experiments of four browsers."""
    done, lock = [0], threading.Lock()

    def resident() -> float:
        [line] = [
            line
            for line in Path(f"/proc/{process}/status").read_text().splitlines()
            if line.startswith("VmRSS")
        ]
        return int(line.split()[1]) / 1024

    def use() -> None:
        with client(address) as one:
            while True:
                with lock:
                    number = done[0] = done[0] + 1
                if number > EXPERIMENTS:
                    return
                experiment(one, number)

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    sizes = dict[int, float]()
    while any(thread.is_alive() for thread in threads):
        sizes[min(done[0], EXPERIMENTS) // 100 * 100] = resident()
        time.sleep(0.2)
    shown = ", ".join(f"{count}: {size:.1f}" for count, size in sizes.items())
    print(f"memory of the server after so many experiments [MiB]: {shown}")


def paint(page: Page, address: str) -> None:
    """The first paint of the page, as the browser measures it."""
    page.goto(address)
    taken = list[float]()
    for _ in range(10):
        page.reload()
        page.wait_for_selector("#comparison tbody tr")
        taken.append(page.evaluate("performance.getEntriesByName('first-paint')[0].startTime"))
    print(f"first paint: {statistics.median(taken):.0f} ms (median), {max(taken):.0f} ms (longest)")


def zoom(page: Page, address: str) -> None:
    """A zoom of input, two outputs and a residual of 10^5 samples: the script, and the pixels."""
    page.goto(address)
    page.wait_for_selector("#comparison tbody tr")
    taken = page.evaluate(ZOOM, SAMPLES)
    for what, own in zip(("script", "with its pixels"), zip(*taken, strict=True), strict=True):
        middle, most = statistics.median(own), max(own)
        print(f"zoom of three plots of {SAMPLES} samples, {what}: {middle:.0f} ms (median), "
              f"{most:.0f} ms (longest of {len(own)})")  # fmt: skip


def main() -> None:
    """Measures what is asked for; without words all."""
    asked = sys.argv[1:] or ["load", "memory", "paint", "zoom"]
    with served() as (address, process), tempfile.TemporaryDirectory() as folder:
        with client(address) as one:
            experiment(one, 0)  # everything is compiled
        if "load" in asked:
            load(address)
        if "memory" in asked:
            memory(address, process)
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch_persistent_context(
                folder, executable_path=shutil.which("chromium"), args=["--no-sandbox"]
            )
            page = browser.new_page()
            if "paint" in asked:
                paint(page, address)
            if "zoom" in asked:
                zoom(page, address)
            browser.close()


if __name__ == "__main__":
    main()
