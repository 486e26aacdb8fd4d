"""Forms of the page as they come: fields, and files that are streamed through, part by part."""

from __future__ import annotations

import re
from http import HTTPStatus
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl

from starlette.datastructures import ImmutableMultiDict
from starlette.exceptions import HTTPException

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from starlette.requests import Request

_MOST_BYTES = 1_000_000
"""Largest form without files [bytes]."""
_NAME = re.compile(rb'filename="((?:[^"\\]|\\.)*)"', re.IGNORECASE)


def refused(text: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> HTTPException:
    """What to raise where a request makes no sense, or asks for what is not there."""
    return HTTPException(status, text)


async def fields_of(request: Request) -> ImmutableMultiDict[str, str]:
    """Fields of a form without files."""
    body = b""
    async for some in request.stream():
        body += some
        if len(body) > _MOST_BYTES:
            raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "More than a form holds.")
    return ImmutableMultiDict(parse_qsl(body.decode(errors="replace"), keep_blank_values=True))


async def files_in(pieces: AsyncIterator[bytes], content_type: str) -> AsyncIterator[tuple[str, bytes | None]]:
    """Files of a multipart form (RFC 7578): the name of each with its bytes, piece by piece, and then with None.

    Parts that are no files are passed over; no more of a file is in memory than one piece.
    """
    found = re.search(r'boundary="?([^";]+)"?', content_type)
    if found is None:
        raise refused("A form with files was expected.")
    boundary = b"\r\n--" + found[1].encode()
    held, name, in_head = b"\r\n", "", False
    async for piece in pieces:
        held += piece
        while True:
            if in_head:
                head, end, rest = held.partition(b"\r\n\r\n")
                if not end:
                    if len(held) > _MOST_BYTES:
                        raise refused("A form with files was expected.")
                    break
                given = _NAME.search(head)
                name = given[1].decode(errors="replace").replace('\\"', '"').replace("%22", '"') if given else ""
                held, in_head = rest, False
            content, mark, rest = held.partition(boundary)
            if not mark:
                sure = max(len(held) - len(boundary), 0)  # the rest may be the beginning of one
                if name and sure:
                    yield name, held[:sure]
                held = held[sure:]
                break
            if name:
                yield name, content
                yield name, None
            held, name, in_head = rest, "", True
            if rest.startswith(b"--"):
                return
    raise refused(f"{name or 'The form'}: did not arrive completely. What did is in the list.")
