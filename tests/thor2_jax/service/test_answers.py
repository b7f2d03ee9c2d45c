"""Answers of a running service to valid requests, compared with the library on the same run."""

import asyncio
import io
import pickle
import socket
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from processes import HANG
from refusals import assert_refused
from service_requests import check_refused
from small_clouds import CLOSED, NETWORK, random_clouds
from small_runs import assert_same_answers

import thor2_jax as thor2
from thor2_jax.client import AsyncClient, Client, ServiceError, _recognitions
from thor2_jax.frames.frames import encode_image
from thor2_jax.frames.intrinsics import parse_intrinsics
from thor2_jax.segmentation.table import segment_table

from .conftest import CLASSES, Files


def test_recognize_matches_the_library(
    server: Any, http: httpx.Client, frame: thor2.RGBDFrame, files: Files, run_dir: Path, tmp_path: Path
) -> None:
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    recognitions = Client(server.url, timeout=HANG).recognize(**{name: tmp_path / name for name in files})
    expected = thor2.Recognizer.load(run_dir).recognize(frame)
    assert_same_answers(recognitions, expected, 1e-5)
    for one, other in zip(recognitions, expected, strict=True):
        for name, best in one.top.items():
            assert len(best) == 5 and dict(best) == pytest.approx(dict(other.top[name]), abs=1e-5)
            assert [p for _, p in best] == sorted((p for _, p in best), reverse=True)
    answer = http.post("/v1/recognize", files=files).json()
    later = {"instances": [one | {"field": "of a later version"} for one in answer["instances"]]}
    assert _recognitions(httpx.Response(200, json=later)) == (recognitions, None)
    assert "30" in answer["instances"][1]["unrecognized"] and answer["label_map"] is None
    assert set(answer["timings"]) == {"upload", "decode", "clouds", "device", "total"}
    assert answer["timings"]["total"] >= answer["timings"]["decode"] + answer["timings"]["clouds"] > 0
    images = {**files, "color": encode_image(frame.color, "JPEG")}
    of_jpeg = http.post("/v1/recognize", files=images)
    assert of_jpeg.status_code == 200 and len(of_jpeg.json()["instances"]) == 4


def test_frames_without_instances_or_depth(http: httpx.Client, files: Files) -> None:
    empty = encode_image(np.zeros((240, 320), np.uint8))
    assert http.post("/v1/recognize", files=files | {"labels": empty}).json()["instances"] == []
    blind = encode_image(np.zeros((240, 320), np.uint16))
    instances = http.post("/v1/recognize", files=files | {"depth": blind}).json()["instances"]
    assert len(instances) == 4 and all(one["unrecognized"] for one in instances)


def test_a_frame_without_labels_is_segmented(
    server: Any, http: httpx.Client, scene: thor2.RGBDFrame, unlabelled: Files
) -> None:
    client = Client(server.url, timeout=HANG)
    recognitions, labels = client.recognize_frame(**unlabelled)
    np.testing.assert_array_equal(labels, segment_table(scene))
    assert [r.label for r in recognitions] == [1, 2, 3]
    assert [r.points_used > 100 for r in recognitions] == [True] * 3
    again, none = client.recognize_frame(**unlabelled, labels=labels)
    assert none is None
    assert [(r.name, r.confidence) for r in again] == [(r.name, r.confidence) for r in recognitions]
    answer = http.post("/v1/recognize", files=unlabelled).json()
    assert answer["label_map"]["width"] == 320 and answer["timings"]["segment"] > 0
    explained = http.post("/v1/explain", files=unlabelled).json()
    assert len(explained["instances"]) == 3 and set(explained["label_map"]["labels"]) == {0, 1, 2, 3}
    assert http.get("/v1/model").json()["segmenter"] == "table"


def check_described(server: Any, inputs: list[tuple[np.ndarray, np.ndarray]]) -> thor2.Descriptors:
    """Compare the service's descriptors with those of the library, and return the latter."""
    expected = thor2.describe(thor2.PointClouds.pack(inputs), NETWORK, CLOSED)
    answer = Client(server.url, timeout=HANG).describe(inputs)
    np.testing.assert_allclose(answer.tops2, expected.tops2, rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(answer.overflow, expected.overflow)
    return expected


def test_describe_matches_the_library(server: Any, http: httpx.Client) -> None:
    inputs = random_clouds(1, range(100, 1601, 150))  # More than a batch, with up to 1,600 points.
    expected = check_described(server, inputs)
    near = ((xyz, np.maximum(rgb - 1e-11, 0)) for xyz, rgb in inputs[:2])  # the result of a computation
    body = {"clouds": [{"points": xyz.tolist(), "colors": rgb.tolist()} for xyz, rgb in near]}
    answer = http.post("/v1/describe", json=body).json()
    assert set(answer["timings"]) == {"upload", "decode", "device", "total"}
    for k, one in enumerate(answer["descriptors"]):
        np.testing.assert_allclose(one["images"], expected.images[k], atol=1e-5)
        np.testing.assert_allclose(one["embeddings"], expected.embeddings[k], rtol=1e-5, atol=1e-4)
        assert one["overflow"] == expected.overflow[k]
    empty = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    one_point = np.ones((1, 3), np.float32), np.zeros((1, 3), np.uint8)
    far_apart = np.array([[-100, 0, 0], [100, 0, 0], [0, 100, 1e-30]], np.float32), np.zeros((3, 3), np.uint8)
    check_described(server, [(xyz, np.full(xyz.shape, 2.5 / 255)) for xyz, _ in inputs[:1]])  # halfway between levels
    degenerate = Client(server.url, timeout=HANG).describe([empty, one_point, far_apart])
    assert not degenerate.tops2[0].any() and np.isfinite(degenerate.tops2).all()
    for cloud in ({"points": [], "colors": []}, {"points": [[1, 0.5, 0]], "colors": [[255.0, 0, 1]]}):
        assert http.post("/v1/describe", json={"clouds": [cloud]}).status_code == 200


def test_model_and_color_network(server: Any, http: httpx.Client) -> None:
    model = Client(server.url, timeout=HANG).model()
    assert model.classes == CLASSES and set(model.classifiers) == {"ce", "tops", "tops2"}
    assert model.config.n_slices == 7 and model.color_network == NETWORK.fingerprint
    assert model.knows == f"{len(CLASSES)} objects: {', '.join(CLASSES[:5])}, ..., {CLASSES[-1]}"
    assert "local/path" not in str(model)
    answer = http.get("/v1/colornet").json()
    np.testing.assert_allclose(answer["mean_rgb"], NETWORK.mean_rgb)
    np.testing.assert_allclose(answer["similarity"], NETWORK.similarity)
    assert len(answer["edges"]) == len(answer["edge_weights"]) == len(NETWORK.edges)


def test_health_page_and_unknown_paths(http: httpx.Client) -> None:
    assert http.get("/healthz").json() == {"status": "alive"}
    assert http.get("/readyz").json() == {"status": "ready", "ready_workers": 1, "workers": 1}
    assert http.get("/").headers["content-type"].startswith("text/html")
    for path in ("/", "/app.js", "/style.css", "/samples/index.json"):
        policy = http.get(path).headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy and "http" not in policy
    for path in ("/", "/healthz", "/v1/model", "/metrics", "/openapi.json", "/missing"):
        assert http.get(path).headers.get_list("x-content-type-options") == ["nosniff"]
    operations = [each for path in http.get("/openapi.json").json()["paths"].values() for each in path.values()]
    assert all("403" in operation["responses"] for operation in operations)
    for path in ("/", "/v1/objects", "/v1/recognize"):
        check_refused(http.get(path, headers={"Host": "evil.example"}), 403, "Host", "evil.example")
    for path in ("/nothing", "/../app.py", "/%2e%2e/app.py"):
        missing = http.get(path)
        assert missing.status_code == 404 and set(missing.json()) == {"field", "message"}
    wrong_method = http.get("/v1/recognize")
    assert wrong_method.status_code == 405 and wrong_method.headers["allow"] == "POST"


def test_the_asynchronous_client_gives_the_same_answers(server: Any, files: Files) -> None:
    async def ask() -> Any:
        client = AsyncClient(server.url, timeout=HANG)
        with pytest.raises(ServiceError, match="depth") as error:
            await client.recognize(**files | {"depth": b"not an image"})
        assert (error.value.status, error.value.field, error.value.retry_after) == (422, "depth", None)
        absent = asyncio.gather(client.recognize(**files | {"depth": "absent"}), return_exceptions=True)
        assert isinstance((await absent)[0], FileNotFoundError)
        return await asyncio.gather(client.recognize(**files), client.objects())

    recognitions, objects = asyncio.run(ask())
    client = Client(server.url, timeout=HANG)
    assert_same_answers(recognitions, client.recognize(**files), 1e-5)
    assert objects == client.objects()
    one, other = ({name: f for name, f in vars(kind).items() if name[0] != "_"} for kind in (AsyncClient, Client))
    assert {name: f.__wrapped__ for name, f in one.items()} == other


def test_no_answer_and_arguments_that_the_client_refuses() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        with pytest.raises(TimeoutError, match="127.0.0.1"):
            Client(url, timeout=0.01).model()
        with pytest.raises(TimeoutError, match=r"\(\w+\)$"):
            asyncio.run(AsyncClient(url, timeout=0.01).model())
    with pytest.raises(ConnectionError, match="127.0.0.1"):
        asyncio.run(AsyncClient(url).model())
    for wrong in ("127.0.0.1:8080", "http://", "ftp://a", "http://[", ""):
        with pytest.raises(ConnectionError, match="gives no answer"):
            Client(wrong).model()
    assert_refused("url is of type NoneType; expected text", AsyncClient, None)
    for token in ("", "é", "secret\n"):
        assert_refused("token", Client, url, token)
    assert_refused("clouds", Client(url).describe, [])
    assert_refused("color is 'a.x00b'", Client(url).recognize, color="a\0b", depth=b"", intrinsics=b"")
    for labels in (np.zeros((2, 2)), np.zeros(4, int), np.full((2, 2), -1), np.full((2, 2), 2**16)):
        assert_refused(
            r"labels has .* from 0 to 65535", Client(url).recognize, color=b"", depth=b"", labels=labels, intrinsics=b""
        )


def test_the_client_sends_colours_and_intrinsics_of_any_type(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: dict[str, Any] = {}
    monkeypatch.setattr(Client, "_send", lambda self, method, path, parse, **body: sent.update(body))
    client = Client("http://robot.local")
    rgb = np.arange(256, dtype=np.uint8)[:255].reshape(-1, 3)
    for colors in (rgb, rgb / 255, (rgb / np.float32(255)).tolist()):
        client.describe([(np.zeros(rgb.shape), colors)])
        np.testing.assert_array_equal(np.load(io.BytesIO(sent["content"]))["colors"], rgb)
    assert_refused(r"clouds\[1\]: rgb", client.describe, [(np.zeros(rgb.shape), rgb), (np.zeros((1, 3)), rgb)])
    matrix = np.array([[500, 0, 320], [0, 510, 240], [0, 0, 1]], np.float32)
    expected = thor2.Intrinsics.of(matrix)
    for given in (matrix, matrix.tolist(), {"K": matrix}, thor2.Intrinsics(*matrix[[0, 1, 0, 1], [0, 1, 2, 2]])):
        client.recognize(color=b"", depth=b"", intrinsics=given)
        assert parse_intrinsics(sent["files"]["intrinsics"]) == expected
    assert_refused("intrinsics", client.recognize, color=b"", depth=b"", intrinsics={"fx": 1})
    image = np.zeros((2, 2, 3), np.uint8)  # arrays are accepted for labels only
    assert_refused("color is .* ndarray", client.recognize, color=image, depth=b"", intrinsics=b"")


def test_clients_and_their_errors_can_be_sent_to_processes() -> None:
    sent = Client("http://127.0.0.1:9"), ServiceError(404, "name", "absent", None)
    client, error = pickle.loads(pickle.dumps(sent))
    assert (str(error), error.field) == ("404: absent", "name")
    with pytest.raises(ConnectionError):
        client.model()


def test_answers_of_other_servers_are_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[httpx.Response] = []
    monkeypatch.setattr(httpx.Client, "request", lambda *_, **__: answers[-1])
    client = Client("http://robot.local")
    for retry_after, seconds in (("7", 7.0), ("Wed, 21 Oct 2026 07:28:00 GMT", None)):  # of a proxy
        answers.append(httpx.Response(503, headers={"Retry-After": retry_after}, text="<html>"))
        with pytest.raises(ServiceError) as error:
            client.model()
        assert (error.value.status, error.value.field, error.value.retry_after) == (503, None, seconds)
    for content in (b"", b"<html>", b"{}", b"[]", b"PK\3\4"):
        answers.append(httpx.Response(200, content=content))
        for call in (client.model, client.objects, lambda: client.describe([(np.zeros((1, 3)), np.zeros((1, 3)))])):
            with pytest.raises(ConnectionError, match="check the URL"):
                call()


def test_no_compilation_after_warm_up(http: httpx.Client, files: Files) -> None:
    """This test comes last in the module: the requests above use all batch shapes."""
    for path in ("/v1/recognize", "/v1/explain"):
        assert http.post(path, files=files).status_code == 200
    lines = http.get("/metrics").text.splitlines()
    values = dict(line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
    assert float(values["thor2_compilations_after_warm_up_total"]) == 0
    assert float(values['thor2_requests_total{path="/v1/recognize",status="200"}']) >= 1
    assert float(values["thor2_batch_clouds_count"]) >= 1


@pytest.mark.slow  # The last test of the file: the server of the tests compiles such sizes at their first request.
def test_clouds_of_all_sizes_match_the_library(server: Any) -> None:
    check_described(server, random_clouds(1, range(100, 7101, 700)))  # up to 7,100 points
