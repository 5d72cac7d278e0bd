"""Starts `dagmap` processes at once: this one has everything imported and forks itself for each.

Speaks lines of JSON: in {"argv": [...], "out": path, "err": path, "file_size": bytes or null},
out {"started": pid} and, when one has ended, {"ended": pid, "code": n}.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sys
import traceback
from typing import Any


def main() -> None:
    from rich.console import Console

    from dagmap.cli.kernels import warm_up
    from dagmap.io.transport import load_zenoh

    warm_up(Console(file=sys.stderr))
    load_zenoh()
    children: set[int] = set()
    say(ready=os.getpid())
    while True:
        readable, _, _ = select.select([0], [], [], 0.02 if children else None)
        if readable:
            line = sys.stdin.buffer.raw.readline()  # type: ignore[union-attr]
            if not line:
                break
            children.add(start(json.loads(line)))
        for pid in list(children):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                children.discard(pid)
                say(ended=pid, code=os.waitstatus_to_exitcode(status))
    for pid in children:
        os.kill(pid, signal.SIGKILL)


def start(order: dict[str, Any]) -> int:
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            code = become(order)
        except BaseException:  # noqa: BLE001, what is a child must not go on as the parent
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    say(started=pid)
    return pid


def become(order: dict[str, Any]) -> int:
    """The command as its entry point runs it; returns the exit code."""
    from dagmap.cli import main as command

    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    for number, path in ((1, order["out"]), (2, order["err"])):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.dup2(file, number)
        os.close(file)
    if order["file_size"] is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (order["file_size"],) * 2)
    sys.argv = ["dagmap", *order["argv"]]
    try:
        command()
    except SystemExit as exit_:
        return exit_.code if isinstance(exit_.code, int) else int(exit_.code is not None)
    return 0


def say(**message: int) -> None:
    os.write(1, json.dumps(message).encode() + b"\n")


if __name__ == "__main__":
    main()
