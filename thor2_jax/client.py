"""A client of the inference service.

>>> client = Client("http://127.0.0.1:8080")                                        # doctest: +SKIP
>>> client.recognize(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")     # doctest: +SKIP
[Recognition(label=1, name='mug', confidence=0.98, ...)]
"""

import io
import json
import secrets
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.recognition.recognizer import Recognition

__all__ = ["Client", "ServiceError", "multipart"]


class ServiceError(Exception):
    """The service refused a request, or could not do it.

    Attributes:
        status: the HTTP status.
        field: the part of the request that is at fault; None if it is none.
        message: what is wrong.
        retry_after: seconds to wait before the next try; None if a try is of no use.
    """

    def __init__(self, status: int, field: str | None, message: str, retry_after: float | None) -> None:
        super().__init__(f"{status}: {message}")
        self.status, self.field, self.message, self.retry_after = status, field, message, retry_after


def multipart(parts: Mapping[str, bytes]) -> tuple[str, bytes]:
    """Content type and body of a multipart form with these parts, each a file."""
    boundary = secrets.token_hex(16)
    pieces = [
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"; filename="{name}"\r\n\r\n'.encode()
        + content
        + b"\r\n"
        for name, content in parts.items()
    ]
    return f"multipart/form-data; boundary={boundary}", b"".join([*pieces, f"--{boundary}--\r\n".encode()])


class Client:
    """Calls one service. It holds no connection and may be used from several threads."""

    def __init__(self, url: str, token: str | None = None, timeout: float = 30.0) -> None:
        """A client of the service at `url`; `timeout` in seconds for each call."""
        self._url, self._token, self._timeout = url.rstrip("/"), token, timeout

    def recognize(
        self, *, color: str | Path | bytes, depth: str | Path | bytes, labels: str | Path | bytes, intrinsics: Any
    ) -> list[Recognition]:
        """Name every instance of a frame, in the order of its label numbers.

        Args:
            color: PNG or JPEG; a path, or the file's content.
            depth: 16-bit PNG.
            labels: PNG of instance numbers.
            intrinsics: a JSON file, or a mapping with fx, fy, cx, cy and, if wanted, depth_scale.

        Raises:
            ServiceError: the service refused it or could not do it.
            OSError: a file cannot be read, or the service not be reached.
        """
        files = {name: _content(given) for name, given in (("color", color), ("depth", depth), ("labels", labels))}
        files["intrinsics"] = (
            json.dumps(dict(intrinsics)).encode() if isinstance(intrinsics, Mapping) else _content(intrinsics)
        )
        answer = json.loads(self._call("/v1/recognize", *multipart(files)))
        return [_recognition(one) for one in answer["instances"]]

    def describe(self, clouds: Sequence[tuple[Any, Any]]) -> dict[str, NDArray[Any]]:
        """Descriptors of clouds, pairs (xyz [n, 3] metres, rgb [n, 3] uint8).

        Returns:
            images [B, S, P, P], embeddings [B, S, R, J] and overflow [B].

        Raises:
            ServiceError: the service refused it or could not do it.
            OSError: the service cannot be reached.
        """
        body = io.BytesIO()
        np.savez_compressed(
            body,
            points=np.concatenate([np.asarray(xyz, np.float32).reshape(-1, 3) for xyz, _ in clouds]),
            colors=np.concatenate([np.asarray(rgb, np.uint8).reshape(-1, 3) for _, rgb in clouds]),
            sizes=np.array([len(xyz) for xyz, _ in clouds]),
        )
        answer = self._call("/v1/describe", "application/octet-stream", body.getvalue())
        with np.load(io.BytesIO(answer), allow_pickle=False) as found:
            return dict(found)

    def model(self) -> dict[str, Any]:
        """What answers: classes, classifiers, the descriptor's version and constants. Raises as `describe`."""
        return json.loads(self._call("/v1/model"))

    def _call(self, path: str, content_type: str | None = None, body: bytes | None = None) -> bytes:
        request = urllib.request.Request(self._url + path, data=body)
        if content_type is not None:
            request.add_header("Content-Type", content_type)
        if self._token is not None:
            request.add_header("Authorization", f"Bearer {self._token}")
        try:
            with urllib.request.urlopen(request, timeout=self._timeout) as answer:
                return answer.read()
        except urllib.error.HTTPError as error:
            with error:
                raise _refusal(error) from None


def _content(given: str | Path | bytes) -> bytes:
    return given if isinstance(given, bytes) else Path(given).read_bytes()


def _refusal(error: urllib.error.HTTPError) -> ServiceError:
    after = error.headers.get("Retry-After")
    try:
        problem = json.loads(error.read())
        field, message = problem["field"], str(problem["message"])
    except (ValueError, KeyError, TypeError):  # something between here and the service answered
        field, message = None, error.reason
    return ServiceError(error.code, field, message, None if after is None else float(after))


def _recognition(one: Mapping[str, Any]) -> Recognition:
    fields = {name: value for name, value in one.items() if name not in ("top", "unrecognized")}
    top = {name: [(c["name"], c["probability"]) for c in best] for name, best in one["top"].items()}
    return Recognition(**fields, top=top, reason=one["unrecognized"])
