"""The whole REST interface and its control loops, in this process: two replicas share a shelf."""

import asyncio
import io
import re
from collections.abc import Iterator
from contextlib import AsyncExitStack
from typing import Any, NamedTuple

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

import dmil_core as dmil
from services.serving.application import GONE, application
from services.serving.guard import Receive, Scope, Send, digest_of
from services.serving.limits import Limits
from services.serving.service import Service
from services.serving.shelf import Shelf
from tests.dmil_core.old_models import METHODS, old_model, recorded
from tests.services.serving.loops import run_apart

TOKEN = "a token"
LIMITS = Limits(policies=3, body_megabytes=0.2, demonstrations=4, steps=50, observations=40)


class Replicas(NamedTuple):
    """Two replicas of one model."""

    model: dmil.Model
    one: TestClient
    other: TestClient


@pytest.fixture
def replicas(request: pytest.FixtureRequest) -> Iterator[Replicas]:
    model, shelf = old_model(getattr(request, "param", "dmil")), Shelf(LIMITS)
    one, other = (application(Service(model, shelf, LIMITS), digest_of(TOKEN)) for _ in range(2))

    async def both(scope: Scope, receive: Receive, send: Send) -> None:
        """Answer as the replica that the address names, in the one event loop that the shelf is in."""
        if scope["type"] != "lifespan":
            await (other if b"other" in dict(scope["headers"])[b"host"] else one)(scope, receive, send)
            return
        async with AsyncExitStack() as stack:
            for guard in (one, other):
                app: Any = guard._application
                await stack.enter_async_context(app.router.lifespan_context(app))
            await send({"type": "lifespan.startup.complete"})
            await receive()
            await receive()
        await send({"type": "lifespan.shutdown.complete"})

    header = {"authorization": f"Bearer {TOKEN}"}
    with TestClient(both, headers=header) as client:
        second = TestClient(both, "http://other", headers=header)
        second.portal = client.portal
        yield Replicas(model, client, second)


def posted(demonstrations: Any, **more: Any) -> dict[str, Any]:
    return {
        "demonstrations": [
            {"observations": observations.tolist(), "actions": actions.tolist()}
            for observations, actions in demonstrations
        ],
        **more,
    }


@pytest.mark.parametrize("replicas", METHODS, indirect=True)
def test_demonstrations_in_and_the_actions_of_the_same_policy_out_of_every_replica(replicas: Replicas):
    demonstrations = recorded(replicas.model, 2)
    answer = replicas.one.post("/v1/policies", json=posted(demonstrations, steps=3))
    assert answer.status_code == 201, answer.text
    info = answer.json()
    assert info["steps"] == 3
    assert info["demonstrations"] == [len(actions) for _, actions in demonstrations]
    again = replicas.other.post("/v1/policies", json=posted(demonstrations, steps=3))
    assert (again.status_code, again.json()["id"]) == (200, info["id"])

    policy = replicas.model.adapt(demonstrations, steps=3)
    for observations in (demonstrations[0][0][:5], demonstrations[0][0][:18].reshape(3, -1, 39)):  # of one and of many
        memory: dict[str, Any] = {}
        policy.reset()
        for observation in observations:
            question = {"observations": observation.tolist(), **memory}
            answer = replicas.other.post(f"/v1/policies/{info['id']}/act", json=question).json()
            np.testing.assert_array_equal(np.array(answer["actions"], np.float32), policy(observation))
            np.testing.assert_array_equal(answer["sub_skills"], policy.sub_skill)
            memory = {"memory": answer["memory"]}


@pytest.mark.parametrize("replicas", ["dmil", "mlsh"], indirect=True)
def test_a_control_loop_keeps_the_memory_of_its_episode(replicas: Replicas):
    demonstrations = recorded(replicas.model)
    observations = demonstrations[0][0][:12]
    name = replicas.one.post("/v1/policies", json=posted(demonstrations, steps=1)).json()["id"]
    policy = replicas.model.adapt(demonstrations, steps=1)
    with replicas.other.websocket_connect(f"/v1/policies/{name}/control") as loop:
        for episode in range(2):
            policy.reset()
            for step, observation in enumerate(observations):
                loop.send_json({"observation": observation.tolist(), "reset": episode == 1 and step == 0})
                answer = loop.receive_json()
                np.testing.assert_array_equal(np.array(answer["action"], np.float32), policy(observation))
                assert answer["sub_skill"] == policy.sub_skill
        loop.send_bytes(b'{"observation": [1.0, null]}')
        assert loop.receive_json()["detail"][0]["loc"] == ["body", "observation", 1]
        loop.send_json({"observation": [1.0]})
        assert "wanted 39" in loop.receive_json()["detail"][0]["msg"]
        replicas.one.delete(f"/v1/policies/{name}")
        loop.send_json({"observation": observations[0].tolist()})
        with pytest.raises(WebSocketDisconnect) as closed:
            loop.receive_json()
        assert closed.value.code == GONE
    with (
        pytest.raises(WebSocketDenialResponse) as denied,
        replicas.other.websocket_connect(f"/v1/policies/{name}/control"),
    ):
        pass
    assert denied.value.status_code == 410


def test_npz_gives_the_policy_that_json_gives(replicas: Replicas):
    (observations, actions), *_ = recorded(replicas.model)
    content = io.BytesIO()
    np.savez(content, observations=observations, actions=actions)
    header = {"content-type": "application/octet-stream"}
    address = "/v1/policies?steps=2&learning_rate=0.01"
    answer = replicas.one.post(address, content=content.getvalue(), headers=header)
    assert answer.status_code == 201, answer.text
    other = replicas.other.post("/v1/policies", json=posted([(observations, actions)], steps=2, learning_rate=0.01))
    assert other.json() == answer.json() | {"expires_at": other.json()["expires_at"]}
    damaged = replicas.one.post(address, content=content.getvalue()[:-30], headers=header)
    assert (damaged.status_code, damaged.json()["detail"][0]["loc"]) == (422, ["body"])
    assert replicas.one.post("/v1/policies", content=b"", headers={"content-type": "text/csv"}).status_code == 415


def test_who_has_no_token_learns_nothing(replicas: Replicas):
    for header in ({}, {"authorization": "Bearer other"}, {"authorization": f"Basic {TOKEN}"}):
        client = TestClient(replicas.one.app, headers=header)
        for path in ("/v1/policies", "/v1/model", "/metrics", "/openapi.json", "/docs", "/nowhere"):
            answer = client.get(path)
            assert (answer.status_code, answer.headers["www-authenticate"]) == (401, "Bearer")
        with pytest.raises(WebSocketDenialResponse), client.websocket_connect("/v1/policies/a/control"):
            pass
        assert client.get("/healthz").json() == {"status": "ok", "model": replicas.model.checkpoint.digest}


def wrong(**changes: Any) -> dict[str, Any]:
    good = {"demonstrations": [{"observations": [[0.0] * 39] * 5, "actions": [[0.0] * 4] * 5}]}
    return good | changes


def only(**changes: Any) -> dict[str, Any]:
    return {"demonstrations": [wrong()["demonstrations"][0] | changes]}


@pytest.mark.parametrize(
    ("body", "where", "what"),
    [
        (wrong(steps=1.5), ["steps"], "integer"),
        (wrong(steps=51), ["steps"], "at most 50"),
        (wrong(learning_rate=0), ["learning_rate"], "greater than 0"),
        (wrong(other=1), ["other"], "not permitted"),
        (wrong(demonstrations=[]), ["demonstrations"], "at least 1"),
        (wrong(demonstrations=5 * wrong()["demonstrations"]), ["demonstrations"], "at most 4"),
        (only(actions=[[0.0, 0, "0", 0]]), ["demonstrations", 0, "actions", 0, 2], "valid number"),
        (only(actions=[[0.0] * 4, [0.0] * 3]), ["demonstrations", 0, "actions", 1], "3 numbers in row 1"),
        (only(actions=[[0.0] * 3] * 5), ["demonstrations", 0, "actions"], r"\(5, 3\); wanted \(steps, 4\), as ml10"),
        (only(actions=[[0.0] * 4] * 3), ["demonstrations", 0, "actions"], "3 steps for 5 of observations"),
        (only(observations=[[1e60] * 39] * 5), ["demonstrations", 0, "observations"], "beyond float32"),
    ],
)
def test_what_is_wrong_is_named_by_its_place(replicas: Replicas, body: dict[str, Any], where: list[Any], what: str):
    answer = replicas.one.post("/v1/policies", json=body)
    assert answer.status_code == 422
    problem = answer.json()["detail"][0]
    assert problem["loc"] == ["body", *where]
    assert re.search(what, problem["msg"])


def test_observations_that_a_policy_cannot_act_on_are_named(replicas: Replicas):
    name = replicas.one.post("/v1/policies", json=wrong()).json()["id"]
    zeros = [0.0] * 39
    for body, where in (
        ({"observations": zeros[1:]}, ["observations"]),
        ({"observations": [zeros, zeros[1:]]}, ["observations", 1]),
        ({"observations": [*zeros[1:], True]}, ["observations", 38]),
        ({"observations": [zeros] * 41}, ["observations"]),
        ({"observations": [3e38] * 39}, ["observations"]),
        ({"observations": zeros, "memory": [1]}, ["memory"]),
        ({"observations": [zeros], "memory": [1]}, ["memory"]),
        ({"observations": zeros, "memory": [[1], [2]]}, ["memory"]),
    ):
        answer = replicas.one.post(f"/v1/policies/{name}/act", json=body)
        assert (answer.status_code, answer.json()["detail"][0]["loc"]) == (422, ["body", *where]), answer.text
    for content, where in ((b'{"observations": [NaN]}', ["observations", 0]), (b"[" * 10_000, []), (b"\xff", [])):
        answer = replicas.one.post(f"/v1/policies/{name}/act", content=content)
        assert (answer.status_code, answer.json()["detail"][0]["loc"]) == (422, ["body", *where])


def test_a_body_that_is_too_large_is_refused_before_it_is_held(replicas: Replicas):
    named = replicas.one.post("/v1/policies", content=b" " * 200_001)
    in_pieces = replicas.one.post("/v1/policies", content=(b" " * 10_000 for _ in range(21)))
    for answer in (named, in_pieces):
        assert (answer.status_code, answer.headers["connection"]) == (413, "close")
        assert "wanted at most 200000" in answer.json()["detail"]


def test_a_policy_is_gone_everywhere_once_its_removal_is_answered(replicas: Replicas):
    name = replicas.one.post("/v1/policies", json=wrong()).json()["id"]
    question = {"observations": [0.0] * 39}
    assert replicas.other.post(f"/v1/policies/{name}/act", json=question).status_code == 200
    assert [one["id"] for one in replicas.other.get("/v1/policies").json()] == [name]
    assert replicas.one.delete(f"/v1/policies/{name}").status_code == 204
    for answer in (
        replicas.other.post(f"/v1/policies/{name}/act", json=question),
        replicas.other.get(f"/v1/policies/{name}"),
        replicas.other.delete(f"/v1/policies/{name}"),
    ):
        assert (answer.status_code, "gone: deleted" in answer.json()["detail"]) == (410, True)
    assert replicas.one.get("/v1/policies/never").status_code == 404
    assert replicas.other.post("/v1/policies", json=wrong()).json()["id"] == name
    assert replicas.one.post(f"/v1/policies/{name}/act", json=question).status_code == 200


def test_above_the_quota_the_one_posted_longest_ago_is_evicted_and_says_so(replicas: Replicas):
    answers = [replicas.one.post("/v1/policies", json=wrong(steps=steps, learning_rate=1e-9)) for steps in range(3)]
    first, second, _ = (answer.json()["id"] for answer in answers)
    again = replicas.other.post("/v1/policies", json=wrong(steps=0, learning_rate=1e-9))
    assert (again.status_code, again.json()["id"]) == (200, first)  # and no longer the oldest
    replicas.one.post("/v1/policies", json=wrong(steps=3, learning_rate=1e-9))
    assert replicas.other.get(f"/v1/policies/{first}").status_code == 200
    answer = replicas.other.get(f"/v1/policies/{second}")
    assert (answer.status_code, "evicted for want of room" in answer.json()["detail"]) == (410, True)


def test_too_much_at_once_is_refused_for_now():
    limits = Limits(requests=2, adaptations=1)
    service = Service(old_model(), Shelf(limits), limits)

    async def ask() -> list[httpx2.Response]:
        guarded = application(service, digest_of(TOKEN))
        header = {"authorization": f"Bearer {TOKEN}"}
        async with httpx2.AsyncClient(
            transport=httpx2.ASGITransport(guarded), base_url="http://a", headers=header
        ) as c:
            return await asyncio.gather(*(c.post("/v1/policies", json=wrong(steps=steps)) for steps in range(3)))

    answers = run_apart(ask())
    assert sorted(answer.status_code for answer in answers) == [201, 429, 429]
    assert {answer.headers.get("retry-after") for answer in answers} == {None, "1"}


def test_figures_are_those_of_all_replicas(replicas: Replicas):
    for client in (replicas.one, replicas.other, replicas.other):
        client.post("/v1/policies", json=wrong())
    replicas.other.get("/metrics")
    found = replicas.one.get("/metrics").text
    assert 'dmil_serving_requests_total{method="POST",route="/v1/policies",status="201"} 1.0' in found
    assert 'dmil_serving_requests_total{method="POST",route="/v1/policies",status="200"} 2.0' in found
    assert 'dmil_serving_request_seconds_bucket{le="+Inf",route="/v1/policies"} 3.0' in found
    assert "dmil_serving_policies 1.0" in found


def test_a_policy_plays_an_episode_of_the_models_suite(replicas: Replicas, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MUJOCO_GL", "none")
    name = replicas.one.post("/v1/policies", json=wrong()).json()["id"]
    address = f"/v1/policies/{name}/episodes"
    played = replicas.other.post(address, json={"task": "drawer-close", "seed": 3}).json()
    assert len(played["sub_skills"]) == played["steps"] > 0
    assert played["video"] is None
    assert "MUJOCO_GL: got none" in played["note"]
    other = replicas.other.post(address, json={"task": "fly"})
    assert (other.status_code, other.json()["detail"][0]["loc"]) == (422, ["body", "task"])


def test_the_page_holds_nothing_and_lets_nothing_else_run(replicas: Replicas):
    page = TestClient(replicas.one.app).get("/")
    assert page.status_code == 200
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert replicas.model.checkpoint.digest not in page.text


def test_the_model_and_the_token_are_described(replicas: Replicas):
    model = replicas.one.get("/v1/model").json()
    assert (model["obs_dim"], model["action_dim"], model["suite"]) == (39, 4, "ml10")
    document = replicas.one.get("/openapi.json").json()
    assert document["security"] == [{"token": []}]
    assert "application/octet-stream" in document["paths"]["/v1/policies"]["post"]["requestBody"]["content"]
