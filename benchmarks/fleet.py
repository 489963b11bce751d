# SPDX-License-Identifier: Apache-2.0
"""What a fleet study costs beside its drives: 1,000 drives with 1, 2 and many workers, near and far, and one killed.

Each setting drives the same places in a new folder and compares the rows with those of one process. What is measured
 holds on a busy machine, too: seconds of the processor, and the part of its time that a worker spends in tasks
(a task that waits for a processor others use is still in it). Far workers reach their scheduler, a process of its own,
through a relay that holds back every byte for a while, both ways. On two cores with nothing beside it, it takes five
minutes.

`--json docs/scale.json` stores what was measured; `--page docs/scale.md` writes the table into the page, with
`--json FILE --stored` from the stored numbers.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm


class Setting(NamedTuple):
    """Workers, one-way latency, seconds of work in a batch (0: one place each), and whether one is killed half-way."""

    workers: int
    latency_ms: int
    batch_s: float
    killed: bool = False


NEAR = Setting(2, 0, 2.0)
SETTINGS = (
    Setting(1, 0, 2.0),
    NEAR,
    NEAR._replace(killed=True),
    Setting(2, 0, 0.0),
    Setting(8, 50, 0.0),
    Setting(8, 50, 2.0),
)
HZ = 100
FLEET = {
    "format": 1,
    "cars": [{"vehicle": "generated:1000..1004"}],
    "friction": [0.9, 0.5],
    "strategies": ["instantaneous"],
    "dt_s": 1.0 / HZ,
}
#: What a batch may cost beside its work.
ALLOWED = 0.01


# --- a network that takes its time ----------------------------------------------------------------------------------


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, delay_s: float) -> None:
    waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()

    async def take() -> None:
        data = b"start"
        while data:
            data = await reader.read(1 << 16)
            waiting.put_nowait((time.monotonic() + delay_s, data))

    taking = asyncio.create_task(take())
    while True:
        due, data = await waiting.get()
        await asyncio.sleep(max(due - time.monotonic(), 0.0))
        if not data:
            break
        writer.write(data)
        await writer.drain()
    await taking
    writer.close()


def relay(port: int, target: tuple[str, int], delay_s: float) -> None:
    """Listen on a port and pass everything on, both ways, later."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            there, back = await asyncio.open_connection(*target)
            await asyncio.gather(_pass_on(reader, back, delay_s), _pass_on(there, writer, delay_s))

    async def main() -> None:
        async with await asyncio.start_server(serve, "127.0.0.1", port) as server:
            await server.serve_forever()

    asyncio.run(main())


def free_port() -> int:
    """Port nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def await_port(port: int) -> None:
    """Wait until somebody listens on a port."""
    while True:
        with contextlib.suppress(ConnectionError), socket.create_connection(("127.0.0.1", port)):
            return
        time.sleep(0.1)


@contextlib.contextmanager
def far_cluster(workers: int, delay_s: float) -> Iterator[str]:
    """Address of a scheduler whose workers are far away."""
    near, far = free_port(), free_port()
    environment = os.environ | {"NUMBA_NUM_THREADS": "1"}
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(near)]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", f"tcp://127.0.0.1:{far}", "--nthreads", "1"]
    quiet = {"env": environment, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    between = multiprocessing.get_context("spawn").Process(target=relay, args=(far, ("127.0.0.1", near), delay_s))
    between.start()
    programs = [subprocess.Popen([*scheduler, "--no-dashboard"], **quiet)]
    for port in (near, far):
        await_port(port)
    programs.append(subprocess.Popen([*worker, "--nworkers", str(workers), "--no-dashboard"], **quiet))
    try:
        yield f"tcp://127.0.0.1:{near}"
    finally:
        for program in reversed(programs):
            program.terminate()
            program.wait()
        between.terminate()
        between.join()


# --- one setting ----------------------------------------------------------------------------------------------------


def processor_s(client) -> dict[str, float]:
    """Seconds of the processor so far: of this process, the scheduler's (if it is another one), and each worker's."""
    used = {"here": time.process_time()} | client.run(time.process_time)
    if client.run_on_scheduler(os.getpid) != os.getpid():
        used["scheduler"] = client.run_on_scheduler(time.process_time)
    return used


def measure(setting: Setting, plan, folder: Path, expected) -> dict[str, Any]:
    """Drive the plan with a setting."""
    from iwm_sim.cluster import connected
    from iwm_sim.fleet.run import Runner
    from iwm_sim.fleet.store import Store
    from iwm_sim.fleet.task import Drive, fingerprint

    workers, latency_ms, batch_s, killed = setting
    left = [len(plan.drives) // 2] if killed else []
    far = far_cluster(workers, latency_ms / 1000.0) if latency_ms else contextlib.nullcontext(None)
    store = Store(folder)
    words = f"{workers} workers, {latency_ms} ms, {batch_s:g} s{', one killed' if killed else ''}"
    with far as address, connected(address, workers) as client, _progress(plan, words) as bar:

        def done(count: int) -> None:
            bar.update(count)
            if left and bar.n >= left[0]:
                left.clear()
                os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

        client.wait_for_workers(workers, timeout=300)
        running = Runner(store, store.begin(fingerprint(), plan.files), client, batch_s)
        running.check_workers(lambda _: None)
        rss_mb = max(client.run(lambda: __import__("psutil").Process().memory_info().rss).values()) / 2**20
        before = processor_s(client)
        made = running.run(Drive, plan.drives, done)
        client.wait_for_workers(workers, timeout=300)
        after = processor_s(client)
    assert store.table(Drive).equals(expected), "the rows differ from those of one process"
    used = {name: after[name] - before.get(name, 0.0) for name in after}
    served = used.pop("here") + used.pop("scheduler", 0.0)
    in_tasks_s = sum(_took(path)["wall_s"] for path in (folder / "rows").iterdir())
    idle_s = workers * made.wall_s - in_tasks_s
    cores = min(workers, len(os.sched_getaffinity(0)))
    return setting._asdict() | {
        "batches": made.batches,
        "task_cpu_s": made.cpu_s,
        "wall_s": made.wall_s,
        "worker_cpu_ms_per_batch": 1000.0 * (sum(used.values()) - made.cpu_s) / made.batches,
        "scheduler_cpu_s": served,
        "idle_ms_per_batch": 1000.0 * idle_s / made.batches,
        "in_tasks_percent": 100.0 * in_tasks_s / (workers * made.wall_s),
        "busy_percent": 100.0 * (sum(used.values()) + served) / (cores * made.wall_s),
        "worker_mb": rss_mb,
    }


def _progress(plan, words: str) -> tqdm:
    return tqdm(total=len(plan.drives), unit="place", desc=words, file=sys.stderr)


def _took(path: Path) -> dict[str, float]:
    import pyarrow.parquet as pq

    found = pq.read_schema(path).metadata
    return {name: float(found[name.encode()]) for name in ("cpu_s", "wall_s")}


def run(drives: int) -> dict:
    """Measure every setting."""
    from iwm_sim.fleet.plan import plan_of
    from iwm_sim.fleet.run import runner
    from iwm_sim.fleet.store import Store
    from iwm_sim.fleet.task import Drive, fingerprint
    from iwm_sim.study import cases
    from iwm_sim.study.cases import Case

    load, cycles = os.getloadavg()[0], drives // 20
    plan = plan_of("benchmark", FLEET | {"cycles": f"generated:1000..{999 + cycles}"})
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / "serial")
        with runner(store, plan.files, None, 1, 2.0) as running, _progress(plan, "this process") as bar:
            alone = running.run(Drive, plan.drives, bar.update)
        rows = [
            measure(setting, plan, Path(folder) / str(number), store.table(Drive))
            for number, setting in enumerate(SETTINGS)
        ]
    real = {}
    for strategy in ("equal", "instantaneous_slip"):
        case = Case("config/cycles/udds.csv", cases.BASE_CAR, "drag", 0.9, strategy)
        cases.result(case)
        started = time.process_time()
        cases.result(case)
        real[strategy] = time.process_time() - started
    return {
        "drives": 2 * len(plan.drives),
        "hz": HZ,
        "cores": len(os.sched_getaffinity(0)),
        "processor": fingerprint()["processor"],
        "load": load,
        "serial_cpu_s": alone.cpu_s,
        "udds_cpu_s": real,
        "settings": rows,
    }


# --- what it means --------------------------------------------------------------------------------------------------


def text(found: dict) -> str:
    """The table and what follows from it, in Markdown."""
    rows = found["settings"]
    near, far = (
        next(row for row in rows if bool(row["latency_ms"]) == away and not row["batch_s"]) for away in (False, True)
    )
    both = {row["killed"]: row for row in rows if [row[name] for name in ("workers", "batch_s")] == [2, 2.0]}
    hidden_s = [(row["worker_cpu_ms_per_batch"] + row["idle_ms_per_batch"]) / 1000.0 / ALLOWED for row in (near, far)]
    served_ms = 1000.0 * near["scheduler_cpu_s"] / near["batches"]
    real_s = sum(found["udds_cpu_s"].values()) / 2.0
    hours, batches = 1e5 * real_s / 3600.0, 1e5 * real_s / 2.0
    lost_s = both[True]["wall_s"] - both[False]["wall_s"]
    lines = [
        f"{found['drives']} drives (drawn cars and cycles of 300 s, control at {found['hz']} Hz, "
        f"{1000.0 * found['serial_cpu_s'] / found['drives']:.1f} ms of processor each) on {found['cores']} cores "
        f"({found['processor']}), load {found['load']:.1f} before it began; every setting gave the rows of one "
        "process, bit for bit. `python benchmarks/fleet.py`:",
        "",
        "| workers | network | batch | batches | drives a second, each core | drives per second of processor "
        "| scheduler and client, s of processor | worker beside its tasks, ms a batch | worker idle, ms a batch "
        "| of its time in tasks | cores busy |",
        "|---|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
        *(_line(row, found) for row in rows),
        "",
        f"- **Workers at work**: {both[False]['in_tasks_percent']:.1f} % of their time with two of them, start and end "
        f"of the study included; the cores are busy for {both[False]['busy_percent']:.1f} % of it.",
        f"- **What a batch costs beside its work**: {near['worker_cpu_ms_per_batch']:.1f} ms of the worker's processor "
        f"and {served_ms:.1f} ms of scheduler and client, the Parquet file included. A worker waits "
        f"{near['idle_ms_per_batch']:.0f} ms for its next batch on this machine, {far['idle_ms_per_batch']:.0f} ms "
        "over the slow network.",
        f"- **The batch that hides it** to {100 * ALLOWED:g} %: {hidden_s[0]:.1f} s on one machine, "
        f"{hidden_s[1]:.1f} s far away (`--batch`; 2 s is the default).",
        f"- **A killed worker**, one of two, half-way: {both[True]['wall_s']:.1f} s instead of "
        f"{both[False]['wall_s']:.1f}, {lost_s:.1f} s lost. Its batches are done again, and another worker is started.",
        f"- **One scheduler feeds** about {2000.0 / served_ms:.0f} workers with batches of 2 s; more want larger ones.",
        f"- **100,000 drives** of UDDS at 100 Hz, half with equal split, half with `instantaneous_slip`, take "
        f"{hours:.1f} hours of processor ({real_s:.2f} s a drive): {60 * hours / 2:.0f} minutes on 2 cores, "
        f"{60 * hours / 64:.1f} on 64, in {batches:.0f} batches of 2 s, for which scheduler and client need "
        f"{batches * served_ms / 60e3:.1f} minutes. A worker takes {max(row['worker_mb'] for row in rows):.0f} MB.",
    ]
    return "\n".join(lines)


def _line(row: dict, found: dict) -> str:
    """A setting's line of the table."""
    cores = min(row["workers"], found["cores"])
    return (
        f"| {row['workers']}{', one killed' if row['killed'] else ''} "
        f"| {f'{row["latency_ms"]} ms each way' if row['latency_ms'] else 'this machine'} "
        f"| {f'{row["batch_s"]:g} s at most' if row['batch_s'] else 'one place'} | {row['batches']} "
        f"| {found['drives'] / row['wall_s'] / cores:.1f} | {found['drives'] / row['task_cpu_s']:.1f} "
        f"| {row['scheduler_cpu_s']:.1f} | {row['worker_cpu_ms_per_batch']:.1f} | {row['idle_ms_per_batch']:.0f} "
        f"| {row['in_tasks_percent']:.1f} % | {row['busy_percent']:.1f} % |"
    )


def main() -> None:
    """Measure or read, print, store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--stored", action="store_true", help="take the numbers of --json instead of measuring")
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    found = json.loads(options.json.read_text()) if options.stored else run(options.drives)
    if options.json and not options.stored:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    print(text(found))
    if options.page:
        old = options.page.read_text()
        block = f"<!-- measured: benchmarks/fleet.py -->\n{text(found)}\n<!-- end -->"
        options.page.write_text(
            re.sub(r"<!-- measured: benchmarks/fleet.py -->.*?<!-- end -->", lambda _: block, old, flags=re.DOTALL)
        )


if __name__ == "__main__":
    main()
