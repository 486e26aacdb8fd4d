"""Bytes over a live link: sockets and serial devices that survive a peer that comes and goes."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import time
from collections.abc import Sequence
from typing import Any, Final, Protocol

from logparsers.endpoint import Endpoint, Serial, Socket
from logparsers.errors import LinkError

_PIECE: Final = 65_536
"""Bytes that are read at once: the longest datagram."""
_RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Bytes of the socket's buffer: a burst of some 10 000 messages, while the usual 200 kB overflows silently."""
_MOST_PEERS: Final = 16
"""Stations that are remembered and sent to."""
_PATIENCE_S: Final = 5.0
"""How long a connection may take [s]."""
_AGAIN_S: Final = 1.0


class Link(Protocol):
    """A live link; what is sent without a receiver is lost."""

    def send(self, data: bytes) -> None:
        """Send whole frames."""

    def receive(self, timeout_s: float) -> bytes:
        """Bytes that arrived, waiting for the first at most so long [s]; none if nothing came."""

    def close(self) -> None:
        """Give the port back."""


def open_link(endpoint: Endpoint) -> Link:
    """Open an endpoint."""
    kinds: dict[str, type[_UdpIn | _TcpIn | _Redialled]]
    kinds = {"udpin": _UdpIn, "udpout": _UdpOut, "tcpin": _TcpIn, "tcp": _Redialled}
    try:
        return _Redialled(endpoint) if isinstance(endpoint, Serial) else kinds[endpoint.kind](endpoint)
    except socket.gaierror as error:
        raise LinkError(f"{endpoint}: no host of this name ({error.strerror or error})") from None
    except OSError as error:
        raise LinkError(f"{endpoint}: {_why(endpoint, error)}") from None


def _why(endpoint: Endpoint, error: OSError) -> str:
    """What was wrong, and what would help."""
    text = error.strerror or str(error)
    helps = {
        errno.EADDRINUSE: "another program listens there: end it, or choose another port",
        errno.EADDRNOTAVAIL: "this machine has no such address: 127.0.0.1 is itself, 0.0.0.0 all of its networks",
    }
    if isinstance(endpoint, Serial):
        helps = {
            errno.EACCES: "on Linux, members of the group dialout may use serial devices",
            errno.EAGAIN: "another program has it",
            errno.ENOENT: "is it plugged in?",
        }
    if isinstance(error, ConnectionRefusedError | TimeoutError):
        return f"no answer from there ({text}); start the other end first, or wait for it with tcpin:"
    advice = helps.get(error.errno or 0)
    return f"{text}; {advice}" if advice else text


def _opened(kind: int, endpoint: Socket) -> socket.socket:
    """Socket of this machine; on Linux without the option that lets two programs share a port."""
    made, address = socket.socket(socket.AF_INET, kind), (endpoint.host, endpoint.port)
    try:
        if kind == socket.SOCK_STREAM:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # ports of ended connections only
        else:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        (made.connect if endpoint.kind == "udpout" else made.bind)(address)
        made.setblocking(kind == socket.SOCK_STREAM)
    except BaseException:
        made.close()
        raise
    return made


def _readable(of: Sequence[Any], timeout_s: float) -> list[Any]:
    return select.select(of, [], [], max(timeout_s, 0.0))[0]


class _UdpIn:
    """Answers whoever sent something; the latest few of them."""

    def __init__(self, endpoint: Socket) -> None:
        self._socket = _opened(socket.SOCK_DGRAM, endpoint)
        self._peers: dict[Any, None] = {}

    def send(self, data: bytes) -> None:
        for peer in tuple(self._peers):  # another thread may receive meanwhile
            with contextlib.suppress(OSError):
                self._socket.sendto(data, peer)

    def receive(self, timeout_s: float) -> bytes:
        if not _readable([self._socket], timeout_s):
            return b""
        with contextlib.suppress(OSError):  # a datagram of ours without a receiver
            data, peer = self._socket.recvfrom(_PIECE)
            self._peers.pop(peer, None)
            self._peers[peer] = None
            if len(self._peers) > _MOST_PEERS:
                del self._peers[next(iter(self._peers))]
            return data
        return b""

    def close(self) -> None:
        self._socket.close()


class _UdpOut(_UdpIn):
    """Sends to one address, and receives from it alone."""

    def send(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # there is no receiver yet
            self._socket.send(data)


class _TcpIn:
    """Waits for connections, and sends to all of them."""

    def __init__(self, endpoint: Socket) -> None:
        self._socket = _opened(socket.SOCK_STREAM, endpoint)
        self._socket.listen()
        self._peers: list[socket.socket] = []

    def send(self, data: bytes) -> None:
        for peer in tuple(self._peers):
            try:
                peer.sendall(data)
            except OSError:
                self._drop(peer)

    def receive(self, timeout_s: float) -> bytes:
        for ready in _readable([self._socket, *self._peers], timeout_s):
            if ready is self._socket:
                self._peers.append(_prepared(ready.accept()[0]))
                continue
            with contextlib.suppress(OSError):
                data: bytes = ready.recv(_PIECE)
                if data:
                    return data
            self._drop(ready)
        return b""

    def close(self) -> None:
        for each in (*self._peers, self._socket):
            each.close()

    def _drop(self, peer: socket.socket) -> None:
        self._peers.remove(peer)
        peer.close()


class _Redialled:
    """A connection to a server or a serial device; after it broke it is opened again, once a second at most."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._tried_s = time.monotonic()
        self._port: Any = _dialled(endpoint)

    def _is_there(self) -> bool:
        now_s = time.monotonic()
        if self._port is None and now_s - self._tried_s >= _AGAIN_S:
            self._tried_s = now_s
            with contextlib.suppress(OSError):
                self._port = _dialled(self._endpoint)
        return self._port is not None

    def send(self, data: bytes) -> None:
        if self._is_there():
            try:
                (self._port.write if isinstance(self._endpoint, Serial) else self._port.sendall)(data)
            except OSError:
                self.close()

    def receive(self, timeout_s: float) -> bytes:
        if not self._is_there():
            time.sleep(min(max(timeout_s, 0.0), 0.1))  # there is nothing to wait on
            return b""
        data = b""
        with contextlib.suppress(OSError):
            if not _readable([self._port], timeout_s):
                return b""
            data = (self._port.read if isinstance(self._endpoint, Serial) else self._port.recv)(_PIECE)
        if not data:
            self.close()
        return data

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port, self._tried_s = None, time.monotonic()


def _dialled(endpoint: Endpoint) -> Any:  # noqa: ANN401 - a socket, or a serial port, which has no types
    if isinstance(endpoint, Socket):
        return _prepared(socket.create_connection((endpoint.host, endpoint.port), timeout=_PATIENCE_S))
    import serial

    try:
        return serial.Serial(endpoint.device, endpoint.baud, timeout=0, write_timeout=_AGAIN_S, exclusive=True)
    except ValueError:
        raise OSError(errno.EINVAL, f"it has no such rate as {endpoint.baud} bits per second") from None
    except serial.SerialException as error:  # repeats the device and the number of the error in its text
        raise OSError(error.errno, os.strerror(error.errno) if error.errno else str(error)) from None


def _prepared(connection: socket.socket) -> socket.socket:
    """Small frames leave at once; a peer that reads nothing delays the others only briefly."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.settimeout(_AGAIN_S)
    return connection
