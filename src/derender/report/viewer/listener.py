"""A listening socket, opened before anything slow is loaded, so that a port in use is one error at once."""

import errno
import socket


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes any free one.

    Raises:
        ValueError: the port is in use or not allowed, or the address is not one of this machine.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"--port must lie in 0..65535, got {port}: 0 takes any free one")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as problem:
        raise ValueError(f"--host {host} is no address of this machine: use 127.0.0.1") from problem
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(128)
    except OSError as problem:
        listener.close()
        if problem.errno == errno.EADDRINUSE:
            advice = f"port {port} of {host} is in use: choose another --port, or 0 for any free one"
        elif problem.errno == errno.EACCES:
            advice = f"port {port} needs rights that you do not have: choose a --port above 1023, or 0"
        else:
            advice = f"cannot listen on {host} port {port} ({problem.strerror}): use --host 127.0.0.1"
        raise ValueError(advice) from problem
    listener.setblocking(False)
    return listener


def address_of(listener: socket.socket, host: str) -> str:
    """What to type into a browser."""
    port = listener.getsockname()[1]
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "": "127.0.0.1"}.get(host, host)
    return f"http://{f'[{shown}]' if ':' in shown and not shown.startswith('[') else shown}:{port}/"
