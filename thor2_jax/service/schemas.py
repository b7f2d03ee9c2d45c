"""What the service takes and answers, as pydantic models; the OpenAPI document is made from them."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from thor2_jax.capacity import POINT_BUCKETS
from thor2_jax.service.settings import FARTHEST, MAX_CLOUDS, MAX_DETAILED

__all__ = [
    "CLOUDS_BODY",
    "FRAME_FORM",
    "NPZ",
    "Candidate",
    "Clouds",
    "ColorNetworkAnswer",
    "DescribeAnswer",
    "Descriptor",
    "Details",
    "ExplainedFrame",
    "ExplainedInstance",
    "FrameAnswer",
    "Health",
    "Instance",
    "LabelMap",
    "ModelAnswer",
    "Slice",
    "Strip",
]

NPZ = "application/octet-stream"
"""Type of a body that is an npz file."""

Milliseconds = dict[str, float]
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST, allow_inf_nan=False)]
Channel = Annotated[int, Field(ge=0, le=255)]


class Candidate(BaseModel):
    """A class and its probability."""

    name: str
    probability: float


class Instance(BaseModel):
    """What is said of one instance of the label image."""

    label: int = Field(description="Its number in the label image.")
    name: str | None = Field(description="The object's name; null if it was not recognized.")
    confidence: float | None = Field(description="The name's probability by both classifiers together.")
    classifier: str | None = Field(description="The classifier that is surer of the name: tops or tops2.")
    top: dict[str, list[Candidate]] = Field(description="Each classifier's five most probable classes.")
    occluded: bool = Field(description="Hidden in part by another instance, or cut by the image's border.")
    overflow: int = Field(description="Points and pairs that the descriptor has no room for.")
    points_used: int = Field(description="Points of the described cloud.")
    kept_by_fallback: bool = Field(description="Outlier removal was relaxed, as it would have dropped most of it.")
    unrecognized: str | None = Field(description="Why it has no name; null if it has one.")


class FrameAnswer(BaseModel):
    """All instances of a frame, in the order of their labels."""

    instances: list[Instance]
    timings: Milliseconds = Field(description="Milliseconds a stage: upload, decode, clouds, device, total.")


class Strip(BaseModel):
    """The points of one strip of a slice by colour region."""

    strip: int
    regions: list[int]
    weights: list[float] = Field(description="Points in each of these regions; one of m regions counts 1/m in each.")


class Slice(BaseModel):
    """One slice of a cloud, as the descriptor sees it."""

    image: list[list[int]] = Field(description="[P, P] persistence image, 255 at image_peak; axes birth, persistence.")
    strips: list[Strip] = Field(description="Those with points.")


class Details(BaseModel):
    """What a name rests on. Lengths are scaled units."""

    points: list[tuple[float, float, float]] = Field(
        description="The aligned cloud: slices lie along z, strips along x. A random part of a large one."
    )
    colors: list[tuple[int, int, int]] = Field(description="sRGB of these points.")
    slice_borders: list[tuple[float, float]] = Field(description="Where along z each slice begins and ends.")
    image_peak: float = Field(description="Largest value of the persistence images.")
    slices: list[Slice]


class ExplainedInstance(Instance):
    """An instance with what its name rests on."""

    details: Details | None = Field(
        description=f"null if it was not recognized, and past the first {MAX_DETAILED} instances."
    )


class LabelMap(BaseModel):
    """The label image in runs, row after row. A ragged one is made coarser: rows and columns are left out evenly."""

    width: int
    height: int
    labels: list[int]
    lengths: list[int] = Field(description="Pixels that each of `labels` holds on for.")


class ExplainedFrame(BaseModel):
    """All instances of a frame, in the order of their labels, with what their names rest on."""

    instances: list[ExplainedInstance]
    label_map: LabelMap
    timings: Milliseconds = Field(description="Milliseconds a stage: upload, decode, clouds, device, total.")


class Cloud(BaseModel):
    """A coloured point cloud in the camera's frame (x right, y down, z forward)."""

    model_config = ConfigDict(extra="forbid")
    points: Annotated[list[tuple[Coordinate, Coordinate, Coordinate]], Field(max_length=POINT_BUCKETS[-1])] = Field(
        description="Metres."
    )
    colors: Annotated[list[tuple[Channel, Channel, Channel]], Field(max_length=POINT_BUCKETS[-1])] = Field(
        description="sRGB, 0 to 255, one a point."
    )


class Clouds(BaseModel):
    """The body of /v1/describe."""

    model_config = ConfigDict(extra="forbid")
    clouds: Annotated[list[Cloud], Field(min_length=1, max_length=MAX_CLOUDS)]


class Descriptor(BaseModel):
    """TOPS2 of one cloud, part by part. TOPS are the images, CE the embeddings."""

    images: list[list[list[float]]] = Field(description="[S, P, P] persistence images; axes birth, persistence.")
    embeddings: list[list[list[float]]] = Field(description="[S, R, J] colour embeddings, regions by strips.")
    overflow: int = Field(description="Points and pairs that the descriptor has no room for.")


class DescribeAnswer(BaseModel):
    """One descriptor a cloud, in the order given."""

    descriptors: list[Descriptor]
    timings: Milliseconds = Field(description="Milliseconds a stage: upload, decode, device, total.")


class ModelAnswer(BaseModel):
    """The trained run that answers."""

    classes: list[str]
    classifiers: list[str]
    descriptor_version: int
    descriptor: dict[str, Any] = Field(description="The descriptor's constants.")
    color_network: str = Field(description="The colour network's fingerprint.")


class ColorNetworkAnswer(BaseModel):
    """The colour network: R regions and how they touch."""

    mean_rgb: list[list[float]] = Field(description="[R, 3] mean colour of each region, 0 to 255.")
    member_counts: list[int] = Field(description="[R] colours of the grid in each region.")
    edges: list[list[int]] = Field(description="[E, 2] pairs of regions.")
    edge_weights: list[float] = Field(description="[E] distance of the two mean colours.")
    similarity: list[list[float]] = Field(description="[R, R].")
    fingerprint: str


class Health(BaseModel):
    """Whether the service lives, or is ready."""

    status: str


FRAME_FORM: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["color", "depth", "labels", "intrinsics"],
                "properties": {
                    "color": {"type": "string", "format": "binary", "description": "8-bit RGB, PNG or JPEG."},
                    "depth": {
                        "type": "string",
                        "format": "binary",
                        "description": "16-bit PNG, millimetres (or what the intrinsics' depth_scale says); 0 is none.",
                    },
                    "labels": {
                        "type": "string",
                        "format": "binary",
                        "description": "One-channel or indexed PNG of instance numbers; 0 is background.",
                    },
                    "intrinsics": {
                        "type": "string",
                        "description": "JSON with fx, fy, cx, cy in pixels and, if wanted, depth_scale, units a metre.",
                    },
                },
            }
        }
    },
}
"""The body of /v1/recognize in words of the OpenAPI. It is taken apart by hand (`uploads`): FastAPI's own way would put
large files on the disk."""


def _clouds_body() -> dict[str, Any]:
    schema = Clouds.model_json_schema()
    schema["properties"]["clouds"]["items"] = schema.pop("$defs")["Cloud"]  # references would lead out of the document
    binary = {"type": "string", "format": "binary"}
    return {"required": True, "content": {"application/json": {"schema": schema}, NPZ: {"schema": binary}}}


CLOUDS_BODY = _clouds_body()
"""The body of /v1/describe, likewise."""
