"""Client of the inference service.

>>> client = Client("http://127.0.0.1:8080")                                        # doctest: +SKIP
>>> frame = {"color": "c.png", "depth": "d.png", "labels": "l.png", "intrinsics": "k.json"}
>>> client.recognize(**frame)                                                       # doctest: +SKIP
[Recognition(label=1, name='mug', confidence=0.98, ...)]

The service segments a frame without labels (`thor2 serve --segment`); `recognize_frame` returns its labels, too:

>>> del frame["labels"]                                                             # doctest: +SKIP
>>> recognitions, labels = client.recognize_frame(**frame)                          # doctest: +SKIP

A service that teaches (`thor2 serve --teach`) enrolls and forgets objects:

>>> client.enroll("teapot", **frame, instance=3)["views"]                           # doctest: +SKIP
1
>>> client.forget("teapot")                                                         # doctest: +SKIP
"""

import io
import json
import secrets
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.errors import InputError
from thor2_jax.recognition.answers import Recognition

__all__ = ["Client", "ServiceError", "multipart"]


class ServiceError(Exception):
    """Error response of the service.

    Attributes:
        status: HTTP status.
        field: field of the request that caused the error; None if there is none.
        message: description of the error.
        retry_after: seconds after which the request can be repeated; None if repeating it does not help.
    """

    def __init__(self, status: int, field: str | None, message: str, retry_after: float | None) -> None:
        super().__init__(f"{status}: {message}")
        self.status, self.field, self.message, self.retry_after = status, field, message, retry_after


def multipart(files: Mapping[str, bytes]) -> tuple[str, bytes]:
    """Return the content type and the body of a multipart form with these files."""
    boundary = secrets.token_hex(16)
    sections = [
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"; filename="{name}"\r\n\r\n'.encode()
        + content
        + b"\r\n"
        for name, content in files.items()
    ]
    return f"multipart/form-data; boundary={boundary}", b"".join([*sections, f"--{boundary}--\r\n".encode()])


class Client:
    """Client of one service. It keeps no connection open and is thread-safe."""

    def __init__(self, url: str, token: str | None = None, timeout: float = 30.0) -> None:
        """Create a client of the service at `url` with a bearer token and a timeout per request in seconds."""
        self._url, self._token, self._timeout = url.rstrip("/"), token, timeout

    def recognize(
        self,
        *,
        color: str | Path | bytes,
        depth: str | Path | bytes,
        labels: str | Path | bytes | NDArray[Any] | None = None,
        intrinsics: Any,
    ) -> list[Recognition]:
        """Recognize every instance of a frame, in the order of the labels.

        Args:
            color: 8-bit PNG or JPEG, as a path or the content of the file.
            depth: 16-bit PNG.
            labels: PNG of instance numbers, or an array [H, W] of them up to 65,535; None lets the service segment the
                frame.
            intrinsics: JSON file, or a mapping with fx, fy, cx, cy and optionally depth_scale.

        Raises:
            InputError: `labels` is an array of another kind.
            ServiceError: the service returned an error.
            OSError: a file cannot be read, or the service cannot be reached.
        """
        return self.recognize_frame(color=color, depth=depth, labels=labels, intrinsics=intrinsics)[0]

    def recognize_frame(
        self,
        *,
        color: str | Path | bytes,
        depth: str | Path | bytes,
        labels: str | Path | bytes | NDArray[Any] | None = None,
        intrinsics: Any,
    ) -> tuple[list[Recognition], NDArray[np.int32] | None]:
        """Recognize a frame, and return its recognitions and the labels [H, W] that the service made.

        The labels are None if the request had labels. The service halves their size, as often as needed, if a segmenter
        returns more than 50,000 runs of equal labels. Arguments and exceptions as `recognize`.
        """
        files = _frame_files(color, depth, labels, intrinsics)
        answer = json.loads(self._request("/v1/recognize", *multipart(files)))
        label_map = answer.get("label_map")  # Services of version 0.1.0 have none.
        return [_recognition(instance) for instance in answer["instances"]], label_map and _label_image(label_map)

    def describe(self, clouds: Sequence[tuple[Any, Any]]) -> dict[str, NDArray[Any]]:
        """Compute the descriptors of clouds, pairs (xyz [n, 3] in metres, rgb [n, 3] uint8).

        Returns:
            images [B, S, P, P], embeddings [B, S, R, J] and overflow [B].

        Raises:
            InputError: `clouds` is empty.
            ServiceError: the service returned an error.
            OSError: the service cannot be reached.
        """
        if not clouds:
            raise InputError("clouds is empty; expected at least one pair (xyz, rgb)")
        body = io.BytesIO()
        np.savez_compressed(
            body,
            points=np.concatenate([np.asarray(xyz, np.float32).reshape(-1, 3) for xyz, _ in clouds]),
            colors=np.concatenate([np.asarray(rgb, np.uint8).reshape(-1, 3) for _, rgb in clouds]),
            sizes=np.array([len(xyz) for xyz, _ in clouds]),
        )
        answer = self._request("/v1/describe", "application/octet-stream", body.getvalue())
        with np.load(io.BytesIO(answer), allow_pickle=False) as arrays:
            return dict(arrays)

    def model(self) -> dict[str, Any]:
        """Return the classes, classifiers, descriptor version and configuration of the model. Raises as `describe`."""
        return json.loads(self._request("/v1/model"))

    def objects(self) -> list[dict[str, Any]]:
        """Return the objects that may be answered: name, trained, views, source and date. Raises as `describe`."""
        return json.loads(self._request("/v1/objects"))["objects"]

    def enroll(
        self,
        name: str,
        *,
        color: str | Path | bytes,
        depth: str | Path | bytes,
        labels: str | Path | bytes | NDArray[Any],
        intrinsics: Any,
        instance: int,
        extend: bool = False,
        replace: bool = False,
    ) -> dict[str, Any]:
        """Enroll an object from one instance of a frame; all processes of the service recognize it from now on.

        Args:
            name: name of the object.
            color: see `recognize`.
            depth: see `recognize`.
            labels: see `recognize`.
            intrinsics: see `recognize`.
            instance: number of the object in `labels`.
            extend: add the view to those of an object with this name.
            replace: discard the views, and the output of the classifiers, of an object with this name.

        Returns:
            The record of the object, as in `objects`, with the generation of the gallery, for `undo`, and timings.

        Raises:
            InputError: as `recognize`.
            ServiceError: as `describe`; status 409 if the name exists and neither `extend` nor `replace` is given.
            OSError: as `recognize`.
        """
        files = _frame_files(color, depth, labels, intrinsics)
        flags = {"extend": str(extend).lower(), "replace": str(replace).lower()}
        fields = {"name": name, "instance": str(instance), **flags}
        files |= {field: value.encode() for field, value in fields.items()}
        return json.loads(self._request("/v1/objects", *multipart(files)))

    def forget(self, name: str) -> int:
        """Forget an object, and return the generation of the gallery, for `undo`.

        Raises:
            ServiceError: as `describe`; status 404 if no object has this name.
            OSError: the service cannot be reached.
        """
        path = f"/v1/objects/{urllib.parse.quote(name, safe='')}"
        return int(json.loads(self._request(path, method="DELETE"))["generation"])

    def undo(self, generation: int) -> int:
        """Take back the change of the gallery that gave it this generation, and return the new one.

        Raises:
            ServiceError: as `describe`; status 409 if another change was made since.
            OSError: the service cannot be reached.
        """
        form = multipart({"generation": str(generation).encode()})
        return int(json.loads(self._request("/v1/objects/undo", *form))["generation"])

    def _request(
        self, path: str, content_type: str | None = None, body: bytes | None = None, method: str | None = None
    ) -> bytes:
        request = urllib.request.Request(self._url + path, data=body, method=method)
        if content_type is not None:
            request.add_header("Content-Type", content_type)
        if self._token is not None:
            request.add_header("Authorization", f"Bearer {self._token}")
        try:
            with urllib.request.urlopen(request, timeout=self._timeout) as response:
                return response.read()
        except urllib.error.HTTPError as error:
            with error:
                raise _service_error(error) from None


def _frame_files(
    color: str | Path | bytes,
    depth: str | Path | bytes,
    labels: str | Path | bytes | NDArray[Any] | None,
    intrinsics: Any,
) -> dict[str, bytes]:
    files = {"color": _read(color), "depth": _read(depth)}
    if labels is not None:
        files["labels"] = _encode_labels(labels) if isinstance(labels, np.ndarray) else _read(labels)
    files["intrinsics"] = (
        json.dumps(dict(intrinsics)).encode() if isinstance(intrinsics, Mapping) else _read(intrinsics)
    )
    return files


def _read(file: str | Path | bytes) -> bytes:
    return file if isinstance(file, bytes) else Path(file).read_bytes()


def _encode_labels(labels: NDArray[Any]) -> bytes:
    if (
        labels.ndim != 2
        or labels.dtype.kind not in "ui"
        or not labels.size
        or not 0 <= labels.min() <= labels.max() < 2**16
    ):
        raise InputError(
            f"labels has shape {labels.shape} and type {labels.dtype}; expected integers [H, W] from 0 to 65535"
        )
    stream = io.BytesIO()
    Image.fromarray(labels.astype(np.uint16)).save(stream, "PNG")
    return stream.getvalue()


def _label_image(label_map: Mapping[str, Any]) -> NDArray[np.int32]:
    flat = np.repeat(np.array(label_map["labels"], np.int32), label_map["lengths"])
    return flat.reshape(label_map["height"], label_map["width"])


def _service_error(error: urllib.error.HTTPError) -> ServiceError:
    retry_after = error.headers.get("Retry-After")
    try:
        problem = json.loads(error.read())
        field, message = problem["field"], str(problem["message"])
    except (ValueError, KeyError, TypeError):  # The response comes from a proxy, not from the service.
        field, message = None, error.reason
    return ServiceError(error.code, field, message, None if retry_after is None else float(retry_after))


def _recognition(instance: Mapping[str, Any]) -> Recognition:
    fields = {name: value for name, value in instance.items() if name not in ("top", "unrecognized")}
    top = {classifier: [(c["name"], c["probability"]) for c in best] for classifier, best in instance["top"].items()}
    return Recognition(**fields, top=top, reason=instance["unrecognized"])
