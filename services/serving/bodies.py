"""What goes into the service and what comes out, as its OpenAPI document describes it."""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

ONE, MANY = "one", "many"
"""Mark in the path of an error which form a value had; no part of the value is named so."""


def _form(values: Any) -> str:
    return MANY if isinstance(values, list) and values and isinstance(values[0], list) else ONE


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Row = Annotated[list[Number], Field(min_length=1, max_length=2**12)]
Rows = Annotated[list[Row], Field(min_length=1, max_length=2**20)]
Whole = Annotated[int, Field(strict=True, ge=-(2**63), lt=2**63)]
WholeRow = Annotated[list[Whole], Field(max_length=2**12)]
Observations = Annotated[Annotated[Row, Tag(ONE)] | Annotated[Rows, Tag(MANY)], Discriminator(_form)]
Memories = Annotated[
    Annotated[WholeRow, Tag(ONE)] | Annotated[list[WholeRow], Tag(MANY)],
    Discriminator(_form),
]
LearningRate = Annotated[float, Field(strict=True, gt=0, le=1e6, allow_inf_nan=False)]


class Body(BaseModel):
    """A request's body: nothing in it that is not known."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Recorded(Body):
    """One demonstration."""

    observations: Annotated[Rows, Field(description="One row a step, in the units of meta-training.")]
    actions: Annotated[Rows, Field(description="One row a step.")]


class Adaptation(Body):
    """Demonstrations of one task, and how to adapt to them."""

    demonstrations: Annotated[list[Recorded], Field(min_length=1)]
    steps: Annotated[
        int | None, Field(strict=True, ge=0, lt=2**31, description="Gradient steps; the model's if not given.")
    ] = None
    learning_rate: Annotated[LearningRate | None, Field(description="Of these steps; the model's if not given.")] = None


class Question(Body):
    """Observations to act on."""

    observations: Annotated[Observations, Field(description="One row, or one for each of several episodes.")]
    memory: Annotated[
        Memories | None,
        Field(description="As the last answer gave it, in the same form; none at the first step of an episode."),
    ] = None


class Actions(BaseModel):
    """What a policy does; rows as the observations had them."""

    actions: list[float] | list[list[float]]
    """Clipped to the action space."""
    sub_skills: int | list[int]
    memory: list[int] | list[list[int]]


class Step(Body):
    """A message of a control loop: the observation, or that an episode begins, or both."""

    observation: Row | None = None
    reset: Annotated[bool, Field(strict=True)] = False


class Play(Body):
    """An episode of a built-in suite."""

    task: Annotated[str, Field(max_length=200)]
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**31, description="Its number in an evaluation.")] = 0


class Episode(BaseModel):
    """What came of an episode."""

    success: bool
    steps: int
    sub_skills: list[int]
    """The one that acted at each step."""
    video: str | None
    """MP4 in base64."""
    note: str | None
    """Why there is no video."""


class Summary(BaseModel):
    """A policy."""

    id: str
    model: str
    """The digest of the checkpoint that was adapted."""
    steps: int
    learning_rate: float
    demonstrations: list[int]
    """Steps of each."""
    error_before: float
    """Mean squared distance from the demonstrated actions before adaptation."""
    error_after: float
    bytes: int
    created_at: datetime
    expires_at: datetime


class Detailed(Summary):
    """A policy, with what is to be known before a robot moves."""

    warnings: list[str]
    """What is unlike all that meta-training has seen."""
    sub_skills: int
    timelines: list[list[int]]
    """The sub-skill at each step of each demonstration."""


class Described(BaseModel):
    """The model that the service adapts."""

    model: str
    """The digest of its checkpoint."""
    method: str
    suite: str
    obs_dim: int
    action_dim: int
    low: list[float]
    """The least value of each number of an action."""
    high: list[float]
    sub_skills: int
    trained_on: str
    steps: int
    """Gradient steps of an adaptation, if a request names none."""
    learning_rate: float
    tasks: list[str]
    """In which a policy can play an episode; none for a suite of somebody's own."""


class Problem(BaseModel):
    """What is wrong with one part of a request."""

    loc: list[str | int]
    """Where: body, query or path, and the fields down to it."""
    msg: str
    type: str


class Refusal(BaseModel):
    """Why a request is refused."""

    detail: str | list[Problem]


class Health(BaseModel):
    """That a replica answers, and with which model."""

    status: Literal["ok"] = "ok"
    model: str
