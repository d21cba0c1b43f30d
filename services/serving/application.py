"""The service's REST interface and control loops, in front of one replica's `Service`."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Annotated, Any, TypeVar

import numpy as np
from fastapi import FastAPI, Path, Query, Request, WebSocket, WebSocketDisconnect
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from pydantic import BaseModel, ValidationError
from pydantic_core import to_json

from dmil_core.demonstrations import DemonstrationError
from services.demonstrations.npz import arrays_in
from services.serving.bodies import (
    MANY,
    ONE,
    Actions,
    Adaptation,
    Described,
    Detailed,
    Episode,
    Health,
    Play,
    Question,
    Refusal,
    Step,
    Summary,
)  # fmt: skip
from services.serving.guard import Guard
from services.serving.page import HEADERS, page
from services.serving.policies import Arrays, FieldError
from services.serving.service import BusyError, Held, MissingError, Service

MOST_UNPACKED = 8
"""Bytes of the arrays in an npz file for each byte that a body may have."""
MOST_PROBLEMS = 10
REPORT_SECONDS = 2.0
NPZ = "application/octet-stream"
JSON = "application/json"
RETRY_AFTER = {"retry-after": "1"}
GONE = 4410
"""The code that closes a control loop whose policy is gone."""
REFUSALS: dict[int | str, dict[str, Any]] = {
    status: {"model": Refusal, "description": what}
    for status, what in {
        401: "no token, or another",
        404: "never was there",
        410: "is gone, and why",
        413: "a body larger than allowed",
        415: "a body of another type",
        422: "something in it cannot be used, with where it is",
        429: "too much at once: try again after Retry-After",
    }.items()
}
Id = Annotated[str, Path(max_length=64, description="A policy's.")]
T = TypeVar("T", bound=BaseModel)


def application(service: Service, token_digest: str) -> Guard:
    """Return the application of one replica, behind its `Guard`."""

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        tasks = [
            asyncio.create_task(beside)
            for beside in (service.follow_removals(), service.report_figures(REPORT_SECONDS))
        ]
        yield
        for task in tasks:
            task.cancel()

    app = FastAPI(
        title="DMIL", version="1", lifespan=lifespan, docs_url=None, redoc_url=None,
        description="Demonstrations in, actions out: policies adapted to a few demonstrations of a new task.",
        responses={status: REFUSALS[status] for status in (401, 413, 429)},
    )  # fmt: skip
    _handle_errors(app)
    _add_policies(app, service)
    _add_actions(app, service)
    _add_figures(app, service)
    usual = app.openapi
    app.openapi = lambda: _with_bearer(usual())
    return Guard(app, token_digest, service.limits, service.metrics)


def _with_bearer(document: dict[str, Any]) -> dict[str, Any]:
    """Return an OpenAPI document that names the token."""
    document["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    document["security"] = [{"token": []}]
    return document


def _handle_errors(app: FastAPI) -> None:
    """Answer errors in one form, without what was got: it may be large, or no JSON."""

    def refused(status: int, detail: Any, headers: dict[str, str] | None = None) -> JSONResponse:
        return JSONResponse({"detail": detail}, status, headers)

    @app.exception_handler(RequestValidationError)
    def _(request: Request, error: RequestValidationError) -> JSONResponse:
        return refused(422, _problems(list(error.errors())))

    @app.exception_handler(FieldError)
    def _(request: Request, error: FieldError) -> JSONResponse:
        return refused(422, [{"loc": list(error.where), "msg": str(error), "type": "unusable"}])

    @app.exception_handler(MissingError)
    def _(request: Request, error: MissingError) -> JSONResponse:
        return refused(410 if error.gone else 404, str(error))

    @app.exception_handler(BusyError)
    def _(request: Request, error: BusyError) -> JSONResponse:
        return refused(
            429, "got more adaptations or episodes than a replica takes at once; wanted fewer; try again", RETRY_AFTER
        )


def _problems(errors: list[Any]) -> list[dict[str, Any]]:
    return [
        {
            "loc": [part if isinstance(part, int) else str(part) for part in error["loc"] if part not in (ONE, MANY)],
            "msg": str(error["msg"]),
            "type": str(error["type"]),
        }
        for error in errors[:MOST_PROBLEMS]
    ]


async def _body(request: Request, model: type[T]) -> T:
    """Read a body of JSON."""
    return _validated(await request.body(), model)


def _validated(content: bytes | str, model: type[T]) -> T:
    try:
        return model.model_validate_json(content)
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)
        raise RequestValidationError([{**one, "loc": ("body", *one["loc"])} for one in found]) from None


def _documented(model: type[BaseModel], **others: Any) -> dict[str, Any]:
    """Return what the OpenAPI document says of a body that `_body` reads, or one of another type."""
    schema = model.model_json_schema()
    definitions = schema.pop("$defs", {})

    def inlined(part: Any) -> Any:
        if isinstance(part, dict):
            name = part.get("$ref", "").removeprefix("#/$defs/")
            return inlined(definitions[name]) if name else {key: inlined(value) for key, value in part.items()}
        return [inlined(one) for one in part] if isinstance(part, list) else part

    content = {JSON: {"schema": inlined(schema)}, **others}
    return {"requestBody": {"required": True, "content": content}}


def _add_policies(app: FastAPI, service: Service) -> None:
    binary = {NPZ: {"schema": {"type": "string", "format": "binary"}}}

    @app.post(
        "/v1/policies", response_model=Detailed, status_code=201, openapi_extra=_documented(Adaptation, **binary),
        responses={200: {"model": Detailed, "description": "it was there already"}} | _refusals(415, 422),
    )  # fmt: skip
    async def adapt(
        request: Request,
        steps: Annotated[int | None, Query(ge=0, lt=2**31, description="Of a body of npz.")] = None,
        learning_rate: Annotated[
            float | None, Query(gt=0, le=1e6, allow_inf_nan=False, description="Of a body of npz.")
        ] = None,
    ) -> Response:
        """Adapt the model to demonstrations of one task, as JSON or as npz; the same ones give the same policy."""
        kind = request.headers.get("content-type", JSON).partition(";")[0].strip().lower()
        if kind not in (JSON, NPZ):
            return JSONResponse({"detail": f"content-type: got {kind[:80]}; wanted {JSON} or {NPZ}"}, 415)
        content = await request.body()
        if kind == NPZ:
            recorded = await asyncio.to_thread(_from_npz, content, service)
        else:
            recorded, body = await asyncio.to_thread(_from_json, content)
            steps, learning_rate = body.steps, body.learning_rate
        posted = await service.adapt(recorded, steps, learning_rate)
        return JSONResponse(posted.info, 201 if posted.new else 200)

    @app.get("/v1/policies", response_model=list[Summary])
    async def policies() -> list[dict[str, Any]]:
        """Return all policies, the one posted longest ago first."""
        return await service.all()

    @app.get("/v1/policies/{id}", response_model=Detailed, responses=_refusals(404, 410, 422))
    async def policy(id: Id) -> dict[str, Any]:
        """Return what is known of a policy."""
        return await service.info(id)

    @app.delete("/v1/policies/{id}", status_code=204, responses=_refusals(404, 410, 422))
    async def delete(id: Id) -> None:
        """Remove a policy; it acts no more when this is answered."""
        await service.delete(id)


def _refusals(*statuses: int) -> dict[int | str, dict[str, Any]]:
    return {status: REFUSALS[status] for status in statuses}


def _from_npz(content: bytes, service: Service) -> list[Arrays]:
    try:
        return arrays_in(content, most=MOST_UNPACKED * service.limits.body)
    except DemonstrationError as error:
        raise FieldError(str(error), "body") from error


def _from_json(content: bytes) -> tuple[list[Arrays], Adaptation]:
    body = _validated(content, Adaptation)
    return [
        (
            _array(one.observations, "body", "demonstrations", index, "observations"),
            _array(one.actions, "body", "demonstrations", index, "actions"),
        )
        for index, one in enumerate(body.demonstrations)
    ], body


def _array(rows: list[list[float]], *where: str | int) -> np.ndarray:
    """Return rows, which are all as long as the first, as float32; what does not fit becomes infinite."""
    wanted = len(rows[0])
    for index, row in enumerate(rows):
        if len(row) != wanted:
            got = f"{where[-1]}: got {len(row)} numbers in row {index} and {wanted} in the first"
            raise FieldError(f"{got}; wanted as many in all", *where, index)
    with np.errstate(over="ignore"):
        return np.array(rows, np.float64).astype(np.float32)


def _add_actions(app: FastAPI, service: Service) -> None:
    @app.post(
        "/v1/policies/{id}/act", response_model=Actions, openapi_extra=_documented(Question),
        responses=_refusals(404, 410, 422),
    )  # fmt: skip
    async def act(id: Id, request: Request) -> Response:
        """Act on one observation, or on one of each of several episodes; an episode's memory goes to and fro."""
        question = await _body(request, Question)
        held = await service.held(id)
        many = isinstance(question.observations[0], list)
        rows: Any = question.observations if many else [question.observations]
        if len(rows) > service.limits.observations:
            most = f"observations: got {len(rows)}; wanted at most {service.limits.observations} at once"
            raise FieldError(most, "body", "observations")
        memory = None if question.memory is None else _memory(question.memory, many=many)
        decision = await service.act(held, _array(rows, "body", "observations"), memory)
        values = decision.actions, decision.sub_skills, decision.memory
        answer = dict(zip(Actions.model_fields, (v.tolist() if many else v[0].tolist() for v in values), strict=True))
        return Response(to_json(answer), media_type=JSON)

    @app.post(
        "/v1/policies/{id}/episodes", response_model=Episode, openapi_extra=_documented(Play),
        responses=_refusals(404, 410, 422),
    )  # fmt: skip
    async def play(id: Id, request: Request) -> JSONResponse:
        """Let the policy act in an episode of the suite that the model is of, and film it."""
        episode = await _body(request, Play)
        return JSONResponse(await service.play(id, episode.task, episode.seed))

    @app.websocket("/v1/policies/{id}/control")
    async def control(socket: WebSocket, id: Id) -> None:
        """Answer each observation with an action, and keep the memory of the episode."""
        try:
            held = await service.held(id)
        except MissingError as error:
            await socket.send_denial_response(JSONResponse({"detail": str(error)}, 410 if error.gone else 404))
            return
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            await _control(socket, service, id, held)


def _memory(memory: list[Any], *, many: bool) -> np.ndarray:
    rows = memory if many else [memory]
    if many and memory and not isinstance(memory[0], list):
        raise FieldError("memory: got one row; wanted one for each observation", "body", "memory")
    if not many and memory and isinstance(memory[0], list):
        raise FieldError("memory: got several rows; wanted one, as there is one observation", "body", "memory")
    if len({len(row) for row in rows}) > 1:
        raise FieldError("memory: got rows of several lengths; wanted all alike", "body", "memory")
    return np.array(rows, np.int64).reshape(len(rows), -1 if any(rows) else 0)


async def _control(socket: WebSocket, service: Service, name: str, held: Held) -> None:
    memory = None
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        try:
            if not held.usable:
                held = await service.held(name)
            step = _validated(message.get("text") or message.get("bytes") or "", Step)
            memory = None if step.reset else memory
            answer: dict[str, Any] = {}
            if step.observation is not None:
                decision = await service.act(held, _array([step.observation], "body", "observation"), memory)
                memory = decision.memory
                answer = {"action": decision.actions[0].tolist(), "sub_skill": int(decision.sub_skills[0])}
                service.metrics.steps.inc()
        except MissingError as error:
            await socket.close(GONE, str(error)[:120])
            return
        except FieldError as error:
            answer = {"detail": [{"loc": list(error.where), "msg": str(error), "type": "unusable"}]}
        except RequestValidationError as error:
            answer = {"detail": _problems(list(error.errors()))}
        await socket.send_text(to_json(answer).decode())


def _add_figures(app: FastAPI, service: Service) -> None:
    content = page()

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    async def root() -> HTMLResponse:
        return HTMLResponse(content, headers=HEADERS)

    @app.get("/healthz", response_model=Health, openapi_extra={"security": []})
    async def health() -> Health:
        """Answer; needs no token."""
        return Health(model=service.digest)

    @app.get("/v1/model", response_model=Described)
    async def model() -> Described:
        """Return what goes into a policy, and what comes out."""
        return service.described

    @app.get("/metrics", response_class=Response)
    async def metrics() -> Response:
        """Return the figures of all replicas in Prometheus' format."""
        return Response(await service.figures(), media_type="text/plain; version=0.0.4")
