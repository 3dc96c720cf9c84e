"""What a suite of kind `detection` says: 3D detectors x shifts x severities over a data set."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Names = Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1)]
Severity = Annotated[int, Field(ge=1, le=5)] | Literal["random"]
RECORDED = "recorded"
SHIFTS = [
    "snow", "rain", "fog", "sunlight", "uniform", "gaussian", "impulse", "scale", "shear", "rotation", "motion_blur",
]  # fmt: skip


class Recorded(BaseModel):
    """The validation set that is recorded where none is given: drives in towns that the shipped detectors never saw.

    scenes: of each town; seconds: of a scene, two samples each; width: of the pictures.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    towns: Names = ["Oldmarket", "Larkhill"]
    scenes: int = Field(default=12, ge=1)
    seconds: float = Field(default=8.0, ge=0.5, allow_inf_nan=False)
    width: int = Field(default=800, ge=64)
    seed: int = Field(default=0, ge=0)


class DetectionSuite(BaseModel):
    """One table: 3D detectors x shifts x severities, beside the clean data.

    detectors: names, with weights of your own as NAME=FILE, or module:object; the first is the baseline of mCE; data:
    "recorded", or the root of a data set in the nuScenes schema, with version (default: the one that is there) and
    split; shifts, severities: 1 to 5 or random (dealt to the scenes, all as often, give or take one; drawn by
    sample in the calibration of the paper); replicates: of the bootstrap over scenes; reference: the published table
    shown beside ours.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    kind: Literal["detection"]
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    title: str = ""
    description: str = ""
    detectors: Names = ["fcos3d-light", "pgd-det-light"]
    data: str = Field(default=RECORDED, min_length=1)
    version: str | None = None
    split: str = "val"
    recorded: Recorded = Recorded()
    shifts: Names = SHIFTS
    severities: Annotated[list[Severity], Field(min_length=1)] = [1, 2, 3, 4, 5, "random"]
    calibration: Literal["physical", "paper"] = "physical"
    seed: int = Field(default=0, ge=0)
    replicates: int = Field(default=100, ge=0, le=10_000)
    reference: str | None = None
