"""Requests to an application that is not started, and what its refusals may say."""

import asyncio
import re
from collections.abc import Callable
from typing import Any

import httpx
from fastapi import FastAPI


def calls(app: FastAPI, *requests: Callable[[httpx.AsyncClient], Any], token: str = "secret") -> list[httpx.Response]:
    """Send requests at once and return their responses."""

    async def send_all() -> list[httpx.Response]:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        headers = {"Authorization": f"Bearer {token}"}
        async with httpx.AsyncClient(transport=transport, base_url="http://x", headers=headers) as client:
            return await asyncio.gather(*(request(client) for request in requests))

    return asyncio.run(send_all())


def check_refused(answer: httpx.Response, status: int, field: str | None, *words: str) -> None:
    """Check the status, the field and some words of a refusal, and that it tells nothing of the server."""
    assert answer.status_code == status, answer.text
    problem = answer.json()
    assert set(problem) == {"field", "message"} and problem["field"] == field, problem
    message = re.sub(r"application/(json|octet-stream)|multipart/form-data", "", problem["message"])
    assert [word for word in words if word not in message] == [], message
    internal = ("Traceback", "/", "0x", ".py", "Error", "\n", "\x1b")
    assert len(message) < 4096 and not any(each in message for each in internal), message
