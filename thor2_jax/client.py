"""Clients of the inference service: `Client`, and `AsyncClient` with the same methods as coroutines.

>>> client = Client("http://127.0.0.1:8080")                                        # doctest: +SKIP
>>> frame = {"color": "c.png", "depth": "d.png", "labels": "l.png", "intrinsics": "k.json"}
>>> client.recognize(**frame)                                                       # doctest: +SKIP
[Recognition(label=1, name='mug', confidence=0.98, ...)]

A service with a segmenter needs no labels; `recognize_frame` also returns the labels of the segmentation:

>>> del frame["labels"]                                                             # doctest: +SKIP
>>> recognitions, labels = client.recognize_frame(**frame)                          # doctest: +SKIP

With `thor2 serve --teach`, clients can enroll and forget objects:

>>> client.enroll("teapot", **frame, instance=3).views                              # doctest: +SKIP
1
>>> client.forget("teapot")                                                         # doctest: +SKIP
"""

import contextlib
import dataclasses
import functools
import io
import json
import ssl
import urllib.parse
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import httpx
import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError, as_array
from thor2_jax.files import as_path
from thor2_jax.frames.frames import encode_image
from thor2_jax.frames.intrinsics import Intrinsics
from thor2_jax.model.recognition import Recognition
from thor2_jax.printable import check_name
from thor2_jax.service.hosts import check_token
from thor2_jax.types import Descriptors, check_cloud

__all__ = ["AsyncClient", "Client", "EnrolledObject", "KnownObject", "ServiceError", "ServiceModel", "multipart"]

File = str | Path | bytes
"""A file, as a path or its content."""

P = ParamSpec("P")
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class ServiceModel:
    """The model of a service.

    Attributes:
        classes: names that an answer can have.
        knows: a description of these names in words.
        classifiers: names of the classifiers in use.
        descriptor_version: version of the descriptor.
        config: configuration of the descriptor.
        color_network: fingerprint of the colour network.
        teaches: whether objects can be enrolled and forgotten.
        segmenter: segmenter of frames without labels; None if the service refuses such frames.
    """

    classes: tuple[str, ...]
    knows: str
    classifiers: tuple[str, ...]
    descriptor_version: int
    config: DescriptorConfig
    color_network: str
    teaches: bool
    segmenter: str | None


@dataclasses.dataclass(frozen=True)
class KnownObject:
    """An object that the service can recognize.

    Attributes:
        name: its name.
        trained: whether the classifiers have an output for it.
        views: number of enrolled views.
        source: source of the views: "frames", "mesh" or "mesh and frames"; None without views.
        date: date of the last enrollment, ISO 8601; None without views.
    """

    name: str
    trained: bool
    views: int
    source: str | None
    date: str | None


@dataclasses.dataclass(frozen=True)
class EnrolledObject(KnownObject):
    """An object after its enrollment.

    Attributes:
        generation: generation of the gallery, for `undo`.
        timings: milliseconds per stage of the request.
    """

    generation: int
    timings: Mapping[str, float]


class ServiceError(Exception):
    """Error response of the service.

    Attributes:
        status: HTTP status.
        field: field of the request that caused the error; None if there is none.
        message: description of the error.
        retry_after: seconds after which the request can be repeated; None if repeating it does not help.
    """

    def __init__(self, status: int, field: str | None, message: str, retry_after: float | None) -> None:
        super().__init__(status, field, message, retry_after)  # the arguments, with which pickle creates it again
        self.status, self.field, self.message, self.retry_after = status, field, message, retry_after

    def __str__(self) -> str:
        return f"{self.status}: {self.message}"


def multipart(files: Mapping[str, bytes]) -> tuple[str, bytes]:
    """Return the content type and the body of a multipart form with these files."""
    request = httpx.Request("POST", "http://service", files=files)
    return request.headers["Content-Type"], request.read()


class _Connection:
    """Address of a service, and options of its requests."""

    _tls_context = staticmethod(functools.cache(ssl.create_default_context))  # slower than a request, and not picklable

    def __init__(self, url: str, token: str | None = None, timeout: float = 30.0) -> None:
        check_token(token)
        if not isinstance(url, str):
            raise InputError(f"url is of type {type(url).__name__}; expected text, such as http://localhost:8080")
        self._url = url.rstrip("/")
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._options: dict[str, Any] = dict(base_url=url, headers=headers, timeout=timeout, follow_redirects=True)

    @contextlib.contextmanager
    def _no_answer_named(self) -> Iterator[None]:
        try:
            yield
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            kind = TimeoutError if isinstance(error, httpx.TimeoutException) else ConnectionError
            raise kind(f"{self._url} gives no answer ({str(error) or type(error).__name__})") from None

    def _parsed(self, response: httpx.Response, parse: Callable[[httpx.Response], T]) -> T:
        """Return what `parse` makes of a response; raise ServiceError if its status is an error."""
        if not response.is_success:
            raise _service_error(response)
        try:
            return parse(response)
        except Exception:  # of many types, since another server can answer anything
            raise ConnectionError(f"{self._url} does not answer as the service does; check the URL") from None


class Client(_Connection):
    """Client of the service at `url`, with a bearer token and a timeout per request in seconds.

    It keeps no connection open and is thread-safe. It raises InputError if `url` is not text or the token cannot be
    sent in a header.
    """

    def recognize(
        self, *, color: File, depth: File, labels: File | NDArray[Any] | None = None, intrinsics: Any
    ) -> list[Recognition]:
        """Recognize every instance of a frame, in the order of the labels.

        Args:
            color: 8-bit PNG or JPEG, as a path or the content of the file.
            depth: 16-bit PNG, by default in millimetres.
            labels: PNG of instance numbers, or an array [H, W] of them up to 65,535; None lets the service segment the
                frame.
            intrinsics: file in a format of docs/frames.md, or what `Intrinsics.of` takes: a mapping, a matrix, a ROS
                message or `Intrinsics`; pixels.

        Raises:
            InputError: an image is neither a path nor bytes, `labels` is an array of another kind, or `intrinsics` is
                invalid.
            ServiceError: the service returned an error.
            OSError: a file cannot be read, or the service cannot be reached.
        """
        files = _frame_files(color, depth, labels, intrinsics)
        return self._send("POST", "/v1/recognize", lambda response: _recognitions(response)[0], files=files)

    def recognize_frame(
        self, *, color: File, depth: File, labels: File | NDArray[Any] | None = None, intrinsics: Any
    ) -> tuple[list[Recognition], NDArray[np.int32] | None]:
        """Return the recognitions of a frame and the labels [H, W] of the service's segmentation.

        The labels are None if the request had labels. If a segmenter returns more than 50,000 runs of equal labels, the
        service halves the size of the labels as often as needed. Arguments and exceptions as `recognize`.
        """
        return self._send("POST", "/v1/recognize", _recognitions, files=_frame_files(color, depth, labels, intrinsics))

    def describe(self, clouds: Sequence[tuple[Any, Any]]) -> Descriptors:
        """Compute the descriptors of up to 32 clouds (xyz, rgb) as `PointClouds.pack` takes them; colours have 8 bits.

        Returns:
            Descriptors of the B clouds, as `thor2_jax.describe` returns them; the fields are NumPy arrays.

        Raises:
            InputError: `clouds` is empty, or a cloud is invalid; the message gives its index.
            ServiceError: the service returned an error.
            OSError: the service cannot be reached.
        """
        if not clouds:
            raise InputError("clouds is empty; expected at least one pair (xyz, rgb)")
        points, colors = zip(*(check_cloud(pair, f"clouds[{i}]") for i, pair in enumerate(clouds)), strict=True)
        body = io.BytesIO()
        np.savez_compressed(
            body,
            points=np.concatenate(points),
            colors=np.floor(255 * np.concatenate(colors) + 0.5).astype(np.uint8),  # halves up, as descriptors round
            sizes=np.array([len(xyz) for xyz in points]),
        )
        headers = {"Content-Type": "application/octet-stream"}
        return self._send("POST", "/v1/describe", _descriptors, content=body.getvalue(), headers=headers)

    def model(self) -> ServiceModel:
        """Return the model of the service; raise errors as `describe`."""
        return self._send("GET", "/v1/model", _model)

    def objects(self) -> list[KnownObject]:
        """Return the objects that the service can recognize; raise errors as `describe`."""
        return self._send("GET", "/v1/objects", lambda r: [_known(each, KnownObject) for each in r.json()["objects"]])

    def enroll(
        self,
        name: str,
        *,
        color: File,
        depth: File,
        labels: File | NDArray[Any],
        intrinsics: Any,
        instance: int,
        extend: bool = False,
        replace: bool = False,
    ) -> EnrolledObject:
        """Enroll an object from one instance of a frame; all processes of the service recognize it from now on.

        Args:
            name: name of the object.
            color: see `recognize`.
            depth: see `recognize`.
            labels: see `recognize`.
            intrinsics: see `recognize`.
            instance: number of the object in `labels`.
            extend: add the view to an existing object with this name.
            replace: discard the views of an object with this name, and the classifiers' output for it.

        Returns:
            The object, with the generation of the gallery.

        Raises:
            InputError: as `recognize`, or the name is invalid, such as None, the name of an unknown object.
            ServiceError: as `describe`; status 409 if the name exists and neither `extend` nor `replace` is given.
            OSError: as `recognize`.
        """
        files = _frame_files(color, depth, labels, intrinsics)
        fields = {"name": check_name(name), "instance": instance, "extend": extend, "replace": replace}
        files |= {field: str(value).encode() for field, value in fields.items()}
        return self._send("POST", "/v1/objects", lambda response: _known(response.json(), EnrolledObject), files=files)

    def forget(self, name: str) -> int:
        """Forget an object, and return the generation of the gallery, for `undo`.

        Raises:
            ServiceError: as `describe`; status 404 if no object has this name. No object is named None.
            OSError: the service cannot be reached.
        """
        return self._send("DELETE", f"/v1/objects/{urllib.parse.quote(name or '', safe='')}", _generation)

    def undo(self, generation: int) -> int:
        """Undo the change that created this generation of the gallery, and return the new generation.

        Raises:
            ServiceError: as `describe`; status 409 if the gallery has changed since then.
            OSError: the service cannot be reached.
        """
        return self._send("POST", "/v1/objects/undo", _generation, files={"generation": str(generation).encode()})

    def _send(self, method: str, path: str, parse: Callable[[httpx.Response], T], **body: Any) -> T:
        """Send a request with a body (content, files) and return what `parse` makes of its response."""
        with self._no_answer_named(), httpx.Client(verify=self._tls_context(), **self._options) as http:
            response = http.request(method, path, **body)
        return self._parsed(response, parse)


def _coroutine(
    method: Callable[Concatenate[Client, P], T],
) -> Callable[Concatenate["AsyncClient", P], Coroutine[Any, Any, T]]:
    """Return a method of `Client` as a coroutine of `AsyncClient`, where `_send` is one; errors are raised by await."""

    async def awaited(*args: Any, **kwargs: Any) -> T:
        return await cast(Any, method(*args, **kwargs))

    return cast(Any, functools.wraps(method)(awaited))


class AsyncClient(_Connection):
    """A `Client` whose methods are coroutines: `await client.recognize(...)`."""

    recognize = _coroutine(Client.recognize)
    recognize_frame = _coroutine(Client.recognize_frame)
    describe = _coroutine(Client.describe)
    model = _coroutine(Client.model)
    objects = _coroutine(Client.objects)
    enroll = _coroutine(Client.enroll)
    forget = _coroutine(Client.forget)
    undo = _coroutine(Client.undo)

    async def _send(self, method: str, path: str, parse: Callable[[httpx.Response], T], **body: Any) -> T:
        with self._no_answer_named():
            async with httpx.AsyncClient(verify=self._tls_context(), **self._options) as http:
                response = await http.request(method, path, **body)
        return self._parsed(response, parse)


def _frame_files(color: File, depth: File, labels: File | NDArray[Any] | None, intrinsics: Any) -> dict[str, bytes]:
    files = {"color": _read("color", color), "depth": _read("depth", depth)}
    if labels is not None:
        files["labels"] = _encode_labels(labels) if isinstance(labels, np.ndarray) else _read("labels", labels)
    if not isinstance(intrinsics, File):
        intrinsics = json.dumps(dataclasses.asdict(Intrinsics.of(intrinsics)), default=np.generic.item).encode()
    return files | {"intrinsics": _read("intrinsics", intrinsics)}


def _read(name: str, file: File) -> bytes:
    if not isinstance(file, File):
        raise InputError(f"{name} is of type {type(file).__name__}; expected a path, or the content of a file as bytes")
    return file if isinstance(file, bytes) else as_path(file, name).read_bytes()


def _encode_labels(labels: NDArray[Any]) -> bytes:
    labels = as_array(labels, "labels", "integers [H, W]")
    is_image = labels.ndim == 2 and labels.size and labels.dtype.kind in "ui"
    if not is_image or not 0 <= labels.min() <= labels.max() < 2**16:
        raise InputError(
            f"labels has shape {labels.shape} and type {labels.dtype}; expected integers [H, W] from 0 to 65535"
        )
    return encode_image(labels.astype(np.uint16))


def _recognitions(response: httpx.Response) -> tuple[list[Recognition], NDArray[np.int32] | None]:
    answer = response.json()
    label_map = answer.get("label_map")  # Services of version 0.1.0 have none.
    return [_recognition(instance) for instance in answer["instances"]], label_map and _label_image(label_map)


def _recognition(instance: Mapping[str, Any]) -> Recognition:
    top = {classifier: [(c["name"], c["probability"]) for c in best] for classifier, best in instance["top"].items()}
    return _known({**instance, "top": top, "reason": instance["unrecognized"]}, Recognition)


def _label_image(label_map: Mapping[str, Any]) -> NDArray[np.int32]:
    flat = np.repeat(np.array(label_map["labels"], np.int32), label_map["lengths"])
    return flat.reshape(label_map["height"], label_map["width"])


def _descriptors(response: httpx.Response) -> Descriptors:
    with np.load(io.BytesIO(response.content), allow_pickle=False) as arrays:
        return Descriptors(**arrays)


def _model(response: httpx.Response) -> ServiceModel:
    values = response.json()
    values["config"] = DescriptorConfig.of_record(values.pop("descriptor"))
    values |= {name: tuple(values[name]) for name in ("classes", "classifiers")}
    return _known({"knows": "", "teaches": False, "segmenter": None} | values, ServiceModel)


def _known(values: Mapping[str, Any], kind: type[T]) -> T:
    """Return a record; entries that only later versions of the service have are ignored."""
    names = [field.name for field in dataclasses.fields(cast(Any, kind))]
    return kind(**{name: values[name] for name in names if name in values})


def _generation(response: httpx.Response) -> int:
    return int(response.json()["generation"])


def _service_error(response: httpx.Response) -> ServiceError:
    retry_after = response.headers.get("Retry-After", "")  # in responses of proxies, it may be a date
    try:
        problem = response.json()
        field, message = problem["field"], str(problem["message"])
    except (ValueError, KeyError, TypeError):  # The response comes from a proxy, not from the service.
        field, message = None, response.reason_phrase
    return ServiceError(response.status_code, field, message, float(retry_after) if retry_after.isdecimal() else None)
