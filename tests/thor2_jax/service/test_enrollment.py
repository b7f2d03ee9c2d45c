"""Enrolling and forgetting objects over HTTP: changes, undo, several processes, and bad input."""

import asyncio
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
import httpx
import hypothesis
import numpy as np
import pytest
import schemathesis
from failures import full_disk
from processes import HANG
from refusals import assert_refused
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi import checks
from service_requests import calls, check_refused
from written_files import files_of

import thor2_jax as thor2
from thor2_jax.client import Client, ServiceError
from thor2_jax.frames.frames import encode_image
from thor2_jax.gallery.enrollment import ObjectGallery
from thor2_jax.service import pipeline
from thor2_jax.service.app import create_app
from thor2_jax.service.engine import InferenceEngine, recognize
from thor2_jax.service.pipeline import AdmittedRequest, Service
from thor2_jax.service.settings import Settings

from .conftest import Files, remove_gallery


@pytest.fixture
def http(teaching_url: str, service: Service, files: Files) -> Iterator[httpx.Client]:
    """The service with an empty gallery; it still answers after the test."""
    with httpx.Client(base_url=teaching_url, timeout=HANG) as client:
        yield client
        remove_gallery(service)
        assert len(recognized(client, files)) == 4 and known(client) == {}


def enroll(http: httpx.Client, files: Files, name: str, instance: object = 200, **flags: object) -> httpx.Response:
    return http.post("/v1/objects", files=files, data={"name": name, "instance": str(instance), **flags})


def undo(http: httpx.Client, generation: object) -> httpx.Response:
    return http.post("/v1/objects/undo", files={"generation": str(generation).encode()})


def known(http: httpx.Client) -> dict[str, int]:
    """Return the enrolled objects and the number of their views."""
    return {each["name"]: each["views"] for each in http.get("/v1/objects").json()["objects"] if each["views"]}


def recognized(http: httpx.Client, files: Files) -> list[str | None]:
    return [one["name"] for one in http.post("/v1/recognize", files=files).json()["instances"]]


def test_the_next_frame_knows_an_enrolled_object(http: httpx.Client, files: Files, service: Service) -> None:
    before = http.post("/v1/recognize", files=files).json()["instances"]
    assert list(before[3]["top"]) == ["tops", "tops2"]
    compiled = service.metrics.compilations._value.get()  # by other tests in this process
    answer = enroll(http, files, "tall")
    record = answer.json()
    assert (record["name"], record["trained"], record["views"], record["source"]) == ("tall", False, 1, "frames")
    assert record["generation"] == 1 and {"upload", "decode", "device", "gallery"} <= record["timings"].keys()
    assert recognized(http, files)[3] == "tall"
    listed, model = http.get("/v1/objects").json(), http.get("/v1/model").json()
    assert [(each["name"], each["trained"]) for each in listed["objects"][:2]] == [("a", True), ("b", True)]
    assert listed["objects"][2:] == [{key: record[key] for key in ("name", "trained", "views", "source", "date")}]
    assert model["classes"] == ["a", "b", "tall"] and model["teaches"] is True and listed["generation"] == 1
    assert enroll(http, files, "wide", 7).status_code == 200
    explained = http.post("/v1/explain", files=files).json()["instances"]
    assert [one["name"] for one in explained] == recognized(http, files) and explained[2]["name"] == "wide"
    for name in ("wide", "tall"):
        assert http.delete(f"/v1/objects/{name}").status_code == 200
    assert http.post("/v1/recognize", files=files).json()["instances"] == before
    assert service.metrics.compilations._value.get() == compiled


def test_a_change_meanwhile_does_not_change_what_an_answer_knows(
    http: httpx.Client, files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "recognize", lambda *given: (enroll(http, files, "tall"), recognize(*given))[1])
    assert http.post("/v1/recognize", files=files).json()["knows"] == "2 objects: a, b"
    assert known(http) == {"tall": 1}


def test_extend_replace_and_undo(http: httpx.Client, files: Files) -> None:
    enroll(http, files, "tall")
    check_refused(enroll(http, files, "tall", 7), 409, "name", "extend")
    check_refused(enroll(http, files, "tall", 9), 409, "name")  # before the view is prepared
    assert enroll(http, files, "tall", 7, extend="true").json()["views"] == 2
    again = enroll(http, files, "tall", 7, extend="true").json()
    assert again["views"] == 2 and undo(http, again["generation"]).status_code == 200 and known(http) == {"tall": 2}
    assert enroll(http, files, "tall", 7, replace="true").json()["views"] == 1
    # A trained class needs one of them, too.
    assert enroll(http, files, "a").status_code == 409
    generation = enroll(http, files, "a", replace="true").json()["generation"]
    assert http.get("/v1/model").json()["classes"] == ["b", "tall", "a"]
    undone = undo(http, generation)
    assert undone.status_code == 200 and undone.json()["generation"] == generation + 1
    assert http.get("/v1/model").json()["classes"] == ["a", "b", "tall"] and known(http) == {"tall": 1}
    for other in (generation, 0, 999):  # Another change was made since.
        check_refused(undo(http, other), 409, "generation")


def test_a_name_stored_in_another_unicode_form_is_extended(http: httpx.Client, files: Files, gallery: Path) -> None:
    """Galleries of older versions contain such names."""
    enroll(http, files, "caf\u00e9")
    index = gallery / "index.json"
    index.write_text(index.read_text(encoding="utf-8").replace("\u00e9", "e\u0301"), encoding="utf-8")
    answer = enroll(http, files, "caf\u00e9", 7, extend="true")
    assert (answer.status_code, answer.json()["name"], answer.json()["views"]) == (200, "cafe\u0301", 2)


def test_another_process_sees_a_change_and_is_seen(
    http: httpx.Client, files: Files, frame: Any, teaching_run: Path, gallery: Path
) -> None:
    other = InferenceEngine(Settings(teaching_run, max_batch=8, gallery=gallery, teach=True))
    enroll(http, files, "tall")
    other.refresh()
    assert other.model.names == ("a", "b", "tall")
    library = thor2.Recognizer.load(teaching_run, gallery=gallery)
    library.enroll("wide", [(frame, 7)])
    assert recognized(http, files)[2:] == ["wide", "tall"]
    library.enroll("twin", [(frame, 200)])
    objects = library.gallery.objects  # The service embeds a view as the library.
    np.testing.assert_allclose(objects["tall"].embeddings, objects["twin"].embeddings, atol=5e-3)
    library.forget("tall")
    assert known(http) == {"wide": 1, "twin": 1}


CHANGES = [("POST", "/v1/objects"), ("DELETE", "/v1/objects/a"), ("POST", "/v1/objects/undo")]


def test_without_teach_the_service_refuses_changes(teaching_run: Path, frame: Any, tmp_path: Path) -> None:
    app = create_app(Settings(run := shutil.copytree(teaching_run, tmp_path / "run")))
    thor2.Recognizer.load(run, gallery=run / "gallery").enroll("tall", [(frame, 200)])  # This service embeds no clouds.
    for answer in calls(app, *(lambda c, m=method, p=path: c.request(m, p) for method, path in CHANGES)):
        check_refused(answer, 403, None, "--teach")
    objects, model = calls(app, lambda client: client.get("/v1/objects"), lambda client: client.get("/v1/model"))
    listed = [(each["name"], each["views"], each["date"]) for each in objects.json()["objects"]]
    assert listed == [("a", 0, None), ("b", 0, None)] and model.json()["teaches"] is False
    assert "/v1/objects/undo" not in app.openapi()["paths"]


def test_unusable_galleries_are_refused_at_the_start(
    http: httpx.Client, files: Files, gallery: Path, teaching_run: Path, tmp_path: Path
) -> None:
    assert_refused("gallery: .*index.json", InferenceEngine, Settings(teaching_run, gallery=tmp_path / "none"))
    enroll(http, files, "tall")
    (gallery / "index.json").unlink()
    for teach in (False, True):
        settings = Settings(teaching_run, gallery=gallery, teach=teach)
        assert_refused("thor2 objects --reembed --model RUN --gallery", InferenceEngine, settings)
    (tmp_path / "file").touch()
    settings = Settings(teaching_run, gallery=tmp_path / "file" / "gallery", teach=True)
    assert_refused("gallery: .*gallery cannot be written.*--gallery", InferenceEngine, settings)


BAD_FIELDS = [
    *[{"name": name} for name in ("", "mug\x1b[31m\n", "mug\u202egpj", "Unknown")],
    *[{"name": "m" * length} for length in (201, 100_000)],
    *[{"instance": number} for number in ("three", "-3", "0", "9", "9" * 30)],
    {"instance": "5"},  # has too few points
    {"extend": "maybe"},
    {"extend": "true", "replace": "true"},
]


def test_bad_fields_are_refused_in_one_line(http: httpx.Client, files: Files, gallery: Path) -> None:
    enroll(http, files, "tall")
    before = files_of(gallery)
    for change in BAD_FIELDS:
        answer = enroll(http, files, **({"name": "new"} | change))
        check_refused(answer, 422, list(change)[-1], change.get("instance", "")[:18])
        assert files_of(gallery) == before and known(http) == {"tall": 1}, change


def test_bad_requests_are_refused(http: httpx.Client, files: Files) -> None:
    both = http.post("/v1/objects", files=files).json()
    assert both["field"] == "name" and [one["field"] for one in both["further"]] == ["instance"]
    check_refused(http.post("/v1/objects", files=files | {"name": b"\xff\xfe", "instance": b"200"}), 422, "name")
    camera = json.dumps({"fx": 60.0, "fy": 60.0, "cx": 159.5, "cy": 119.5, "depth_scale": 1000 / 2.6}).encode()
    huge = files | {"intrinsics": camera, "labels": encode_image(np.full((240, 320), 200, np.uint8))}
    assert enroll(http, huge, "huge").json()["field"] in ("instance", "intrinsics")
    for name in ("missing", "a/b", "..", "%00", "", "m" * 3000):
        assert http.delete(f"/v1/objects/{name}").status_code in (404, 405)
    check_refused(http.delete("/v1/objects/a%0Ab"), 404, "name")
    for value in ("", "x", "-1", "1e9", "9" * 40):
        check_refused(undo(http, value), 422, "generation")
    assert known(http) == {}


def test_a_full_disk_leaves_the_gallery(
    http: httpx.Client, files: Files, gallery: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generation = enroll(http, files, "tall").json()["generation"]
    before = files_of(gallery)
    with monkeypatch.context() as patch:
        patch.setattr("thor2_jax.gallery.store.write_text", full_disk)
        for answer in (enroll(http, files, "wide", 7), http.delete("/v1/objects/tall"), undo(http, generation)):
            check_refused(answer, 507, None)
    assert files_of(gallery) == before and enroll(http, files, "wide", 7).status_code == 200


def test_a_damaged_gallery_stops_changes_but_not_recognition(
    http: httpx.Client, files: Files, gallery: Path, caplog: pytest.LogCaptureFixture
) -> None:
    enroll(http, files, "tall")
    index = gallery / "index.json"
    good = index.read_bytes()
    for bad in (b"{", good.replace(b'"embedding": "', b'"embedding": "0'), None):
        index.write_bytes(bad) if bad else index.unlink()
        for answer in (enroll(http, files, "wide", 7), http.delete("/v1/objects/tall"), http.get("/v1/objects")):
            check_refused(answer, 500, None, "gallery: ", *([] if bad else ["thor2 objects", "--gallery GALLERY"]))
        assert (index.read_bytes() if index.exists() else None) == bad and recognized(http, files)[3] == "tall"
        assert http.get("/v1/model").json()["classes"] == ["a", "b", "tall"]
    assert str(gallery) in caplog.text
    index.write_bytes(good)
    gallery.rename(copy := gallery.with_name("copy"))  # and back, which a new directory would hinder
    for answer in (enroll(http, files, "wide", 7), http.delete("/v1/objects/tall"), http.get("/v1/objects")):
        check_refused(answer, 500, None, "gallery: ", "removed")
    assert recognized(http, files)[3] == "tall" and f"{gallery} was removed" in caplog.text
    copy.rename(gallery)
    assert known(http) == {"tall": 1} and enroll(http, files, "wide", 7).status_code == 200


def test_a_change_waits_for_another_writer(
    http: httpx.Client, files: Files, gallery: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enroll(http, files, "tall")
    lock, acquire = filelock.FileLock(gallery / ".lock", thread_local=False), filelock.FileLock.acquire

    def acquire_late(*arguments: Any, **options: Any) -> Any:
        threading.Timer(0.2, lock.release, [True]).start()
        return acquire(*arguments, **options)

    with lock, monkeypatch.context() as patch:
        patch.setattr(filelock.FileLock, "acquire", acquire_late)
        answer = enroll(http, files, "wide", 7)
    assert answer.status_code == 200 and answer.json()["timings"]["gallery"] > 100
    monkeypatch.setattr(pipeline, "LOCK_SHARE", 1e-3)
    before = files_of(gallery)
    with lock:
        refused = enroll(http, files, "other")
        assert refused.headers["retry-after"] == "1"
        check_refused(refused, 503, None)
        assert recognized(http, files)[2:] == ["wide", "tall"]
    monkeypatch.undo()
    assert files_of(gallery) == before and enroll(http, files, "other").status_code == 200


def test_a_change_that_waits_occupies_one_thread(http: httpx.Client, service: Service) -> None:
    """It does so also if its client has disconnected, which cancels the request."""
    begun, at_once, end = list[ObjectGallery](), list[int](), threading.Event()

    def wait(objects: ObjectGallery) -> None:
        begun.append(objects)
        end.wait(HANG)

    async def change_twice() -> None:
        first, second = (asyncio.create_task(service.change(wait, 409, "name", AdmittedRequest(HANG))) for _ in "12")
        while not begun:
            await asyncio.sleep(0.01)
        first.cancel()
        await asyncio.wait([second], timeout=0.2)
        at_once.append(len(begun))
        end.set()
        await second

    asyncio.run(change_twice())
    assert at_once == [1] and len(begun) == 2


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        *(({"Sec-Fetch-Site": site}, 403) for site in ("cross-site", "same-site")),
        *(({"Origin": origin}, 403) for origin in ("http://other.example", "null")),
        # The name of another site that resolves to this server: the browser sees the same origin (DNS rebinding).
        ({"Sec-Fetch-Site": "same-origin", "Origin": "http://evil.example", "Host": "evil.example"}, 403),
        ({"Sec-Fetch-Site": "same-origin", "Origin": "https://behind.a.proxy"}, 200),
        ({"Sec-Fetch-Site": "none"}, 200),
        ({"Origin": "http://HOST"}, 200),
    ],
)
def test_other_sites_cannot_teach(headers: dict[str, str], status: int, http: httpx.Client, files: Files) -> None:
    sent = {name: value.replace("HOST", http.base_url.netloc.decode()) for name, value in headers.items()}
    answer = http.post("/v1/objects", files=files, data={"name": "tall", "instance": "200"}, headers=sent)
    assert answer.status_code == status and known(http) == ({"tall": 1} if status == 200 else {})
    for method, path in CHANGES[1:]:
        assert (http.request(method, path, headers=sent).status_code == 403) == (status == 403)


POSTED = "recognize", "explain", "why", "describe", "objects", "objects/undo"
READ = "/v1/model", "/v1/objects", "/v1/colornet", "/metrics", "/healthz", "/readyz"
OPERATIONS = [*(("post", f"/v1/{name}") for name in POSTED), *(("get", path) for path in READ)]
OPERATIONS += [("delete", "/v1/objects/{name}")]
OF_DOCUMENT = [checks.status_code_conformance, checks.content_type_conformance, checks.response_schema_conformance]


@pytest.mark.parametrize(("method", "path"), OPERATIONS)
def test_openapi_requests_conform(method: str, path: str, http: httpx.Client) -> None:
    """Generated requests; their answers are compared with the OpenAPI document."""
    document, everything = schemathesis.openapi.from_url(f"{http.base_url}/openapi.json"), list(hypothesis.HealthCheck)
    paths = http.get("/openapi.json").json()["paths"]
    assert {(name, each) for each, methods in paths.items() for name in methods} == set(OPERATIONS)

    @hypothesis.settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=everything)
    @hypothesis.given(case=document[path][method].as_strategy())
    def call(case: schemathesis.Case) -> None:
        case.call_and_validate(checks=[not_a_server_error, *OF_DOCUMENT], timeout=HANG)

    call()


def test_the_client_teaches(http: httpx.Client, files: Files) -> None:
    client = Client(str(http.base_url), timeout=HANG)
    record = client.enroll("client/tall ü", **files, instance=200)
    assert record.views == 1 and client.objects()[-1].name == "client/tall ü"
    assert client.enroll("client/tall ü", **files, instance=7, extend=True).views == 2
    generation = client.forget("client/tall ü")
    assert client.undo(generation) == generation + 1
    client.forget("client/tall ü")
    with pytest.raises(thor2.InputError, match="name is None"):
        client.enroll(None, **files, instance=7)  # type: ignore[arg-type]
    for name in ("client/tall ü", None):  # None is the name of an unknown object
        with pytest.raises(ServiceError) as missing:
            client.forget(name)  # type: ignore[arg-type]
        assert (missing.value.status, missing.value.field) == (404, "name")
