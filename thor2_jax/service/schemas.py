"""Request and response bodies as pydantic models, from which the OpenAPI document is generated."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from thor2_jax.capacity import POINT_BUCKETS

FORM = "multipart/form-data"
"""Content type of forms."""

NPZ = "application/octet-stream"
"""Content type of npz files."""

FRAME_STAGES = "Milliseconds per stage: upload, decode, segment (without labels), clouds, device, total."

MAX_POINTS = POINT_BUCKETS[-1]
"""Largest number of points of a cloud."""

MAX_CLOUD_COORDINATE = 100.0
"""Largest absolute value of a coordinate of a cloud, in metres."""

MAX_CLOUDS = 32
"""Largest number of clouds in a request."""

MAX_EXPLAINED = 32
"""Largest number of instances of a frame that are explained."""

Milliseconds = dict[str, float]
Coordinate = Annotated[
    float, Field(strict=True, ge=-MAX_CLOUD_COORDINATE, le=MAX_CLOUD_COORDINATE, allow_inf_nan=False)
]
Channel = Annotated[float, Field(strict=True, ge=0, le=255, multiple_of=1)]


class Candidate(BaseModel):
    """A class and its probability."""

    name: str
    probability: float


class InstanceAnswer(BaseModel):
    """Recognition of one instance of the label image."""

    label: int = Field(description="Number of the instance in the label image.")
    name: str | None = Field(description="Name of the object; null if it is unknown or cannot be recognized.")
    confidence: float | None = Field(
        description="Confidence in the most probable name, from 0 to 1; null if the cloud cannot be used."
    )
    classifier: str | None = Field(
        description="Classifier that gives this class the highest probability: tops, tops2 or embedding, or gallery."
    )
    top: dict[str, list[Candidate]] = Field(description="Five most probable names of each classifier and the gallery.")
    occluded: bool = Field(description="Partly occluded by another instance or cut off by the image border.")
    overflow: int = Field(description="Number of points and persistence pairs outside the descriptor's grid.")
    points_used: int = Field(description="Number of points of the described cloud.")
    kept_by_fallback: bool = Field(description="Outlier removal was relaxed because it would have removed most points.")
    unrecognized: str | None = Field(description="Reason why the name is null; null if there is a name.")


class AdaptationAnswer(BaseModel):
    """The colour transform that the service applies to the camera's images; 0 is no change."""

    instances: int = Field(description="Number of instances of the latest frames in the estimate.")
    gamma: float = Field(description="Logarithm of the exponent.")
    gain: float = Field(description="Logarithm of the factor of all channels.")
    saturation: float = Field(description="Logarithm of the factor of the distance from grey.")
    warmth: float = Field(description="Logarithm of the factor of red and of the inverse factor of blue.")


class FrameAnswer(BaseModel):
    """All instances of a frame, in the order of their labels."""

    instances: list[InstanceAnswer]
    knows: str = Field(description="Description of the objects of the model; other objects are unknown.")
    label_map: "LabelMap | None" = Field(
        default=None, description="Labels of a frame that was segmented; null if the request had labels."
    )
    adaptation: AdaptationAnswer | None = Field(
        default=None, description="Estimated colour transform; null before the first estimate and without --adapt."
    )
    timings: Milliseconds = Field(description=FRAME_STAGES)


class StripColors(BaseModel):
    """Points of one strip of a slice, by colour region."""

    strip: int
    regions: list[int]
    weights: list[float] = Field(description="Points in each region; a point with m regions counts 1/m in each.")


class SliceDetails(BaseModel):
    """Persistence image and strip colours of one slice."""

    image: list[list[int]] = Field(description="[P, P] persistence image, 255 at image_peak; axes birth, persistence.")
    strips: list[StripColors] = Field(description="Strips that contain points.")


class Details(BaseModel):
    """The cloud and the descriptor of an instance. Lengths are in scaled units."""

    points: list[tuple[float, float, float]] = Field(
        description="Aligned cloud, or a random sample of a large one; slices lie along z, strips along x."
    )
    colors: list[tuple[int, int, int]] = Field(description="sRGB colours of these points.")
    slice_borders: list[tuple[float, float]] = Field(description="Start and end of each slice along z.")
    calibrated_confidence: float | None = Field(
        description="Calibrated confidence; null without a calibration, with a gallery, or with forgotten classes."
    )
    image_peak: float = Field(description="Maximum of the persistence images.")
    slices: list[SliceDetails]


class ExplainedInstance(InstanceAnswer):
    """Recognition of an instance, with its cloud and its descriptor."""

    details: Details | None = Field(
        description=f"null if the cloud cannot be used, and after {MAX_EXPLAINED} instances with details."
    )


class LabelMap(BaseModel):
    """The label image, run-length encoded row by row; an image with too many runs is subsampled."""

    width: int
    height: int
    labels: list[int]
    lengths: list[int] = Field(description="Length in pixels of the run of each entry of `labels`.")


class KnownNames(BaseModel):
    """The objects of a model."""

    classes: list[str] = Field(description="Names that an answer can have.")
    knows: str = Field(description="Description of these objects; others are unknown.")


class ExplainedFrame(KnownNames):
    """All instances of a frame with their clouds and descriptors, in the order of their labels."""

    instances: list[ExplainedInstance]
    label_map: LabelMap
    timings: Milliseconds = Field(description=FRAME_STAGES)


class WhyPicture(BaseModel):
    """A picture of an explanation."""

    title: str
    caption: str = Field(description="Description of the picture in full sentences.")
    png: str = Field(description="The picture, a PNG file in base64.")


class WhyAnswer(BaseModel):
    """Explanation of the answer for an instance; `thor2 explain` writes more."""

    label: int
    name: str | None = Field(description="Name of the object; null if it is unknown.")
    explained_name: str = Field(description="The explained name, which is the most probable one.")
    unit: str = Field(description="Explained quantity: log-odds of the classifiers, or similarity to enrolled views.")
    margin: float = Field(description="Explained value: log-odds, or the lead over the most similar other object.")
    loss_without_most_attributed_tenth: float = Field(
        description="Loss of the margin without the tenth of the points that supports the name most."
    )
    mean_loss_without_random_tenth: float = Field(description="Mean loss without a random tenth of the points.")
    changes: list[str] = Field(description="Smallest changes of colour and side lengths to another name, in words.")
    pictures: list[WhyPicture]
    timings: Milliseconds = Field(description="Milliseconds per stage: upload, decode, clouds, explain, total.")


class CloudBody(BaseModel):
    """A coloured point cloud in the camera frame (x right, y down, z forward)."""

    model_config = ConfigDict(extra="forbid")
    points: list[tuple[Coordinate, Coordinate, Coordinate]] = Field(max_length=MAX_POINTS, description="Metres.")
    colors: list[tuple[Channel, Channel, Channel]] = Field(
        max_length=MAX_POINTS, description="sRGB, 0 to 255, one per point."
    )


class CloudsBody(BaseModel):
    """The body of /v1/describe."""

    model_config = ConfigDict(extra="forbid")
    clouds: Annotated[list[CloudBody], Field(min_length=1, max_length=MAX_CLOUDS)]


class DescriptorAnswer(BaseModel):
    """Descriptor of one cloud: TOPS consists of the images, CE of the embeddings, TOPS2 of both."""

    images: list[list[list[float]]] = Field(description="[S, P, P] persistence images; axes birth, persistence.")
    embeddings: list[list[list[float]]] = Field(description="[S, R, J] colour embeddings, regions by strips.")
    overflow: int = Field(description="Number of points and persistence pairs outside the descriptor's grid.")


class DescribeAnswer(BaseModel):
    """One descriptor per cloud, in the order of the request."""

    descriptors: list[DescriptorAnswer]
    timings: Milliseconds = Field(description="Milliseconds per stage: upload, decode, device, total.")


class ModelAnswer(KnownNames):
    """The model of the service."""

    classifiers: list[str]
    descriptor_version: int
    descriptor: dict[str, Any] = Field(description="Configuration of the descriptor.")
    color_network: str = Field(description="Fingerprint of the colour network.")
    teaches: bool = Field(description="Whether objects can be enrolled and forgotten.")
    segmenter: str | None = Field(description="Segmenter of frames without labels; null if they are refused.")


class ObjectAnswer(BaseModel):
    """An object that the model can recognize."""

    name: str
    trained: bool = Field(description="Whether the classifiers have an output for it.")
    views: int = Field(description="Number of enrolled views.")
    source: str | None = Field(description="Source of the views: frames, mesh, or mesh and frames; null without views.")
    date: str | None = Field(description="Date of the last enrollment, ISO 8601; null without views.")


class ObjectsAnswer(BaseModel):
    """All objects that the model can recognize: trained classes, without forgotten ones, and enrolled objects."""

    objects: list[ObjectAnswer]
    generation: int = Field(description="Number of changes of the gallery.")


class ChangeAnswer(BaseModel):
    """A change of the gallery."""

    generation: int = Field(description="Number of changes of the gallery; POST /v1/objects/undo undoes this change.")


class EnrollmentAnswer(ObjectAnswer, ChangeAnswer):
    """The object after its enrollment."""

    timings: Milliseconds = Field(description="Milliseconds per stage: upload, decode, clouds, device, gallery, total.")


class ColorNetworkAnswer(BaseModel):
    """The colour network: R colour regions, the edges between them and their similarity."""

    mean_rgb: list[list[float]] = Field(description="[R, 3] mean sRGB colour of each region, 0 to 255.")
    member_counts: list[int] = Field(description="[R] number of grid colours in each region.")
    edges: list[list[int]] = Field(description="[E, 2] pairs of regions.")
    edge_weights: list[float] = Field(description="[E] HyAB distance between the two mean colours.")
    similarity: list[list[float]] = Field(description="[R, R] similarity matrix Delta.")
    fingerprint: str


class Health(BaseModel):
    """Health of the service."""

    status: str


class Readiness(Health):
    """Readiness of the service."""

    ready_workers: int = Field(description="Number of processes that accept requests.")
    workers: int = Field(description="Number of processes, including those that are starting.")


def _file(description: str) -> dict[str, Any]:
    return {"type": "string", "format": "binary", "description": description}


def _form(properties: dict[str, Any], *optional: str) -> dict[str, Any]:
    required = [name for name in properties if name not in optional]
    schema = {"type": "object", "required": required, "properties": properties, "additionalProperties": False}
    return {"required": True, "content": {FORM: {"schema": schema}}}


_FRAME: dict[str, Any] = {
    "color": _file("8-bit RGB, PNG or JPEG."),
    "depth": _file("16-bit PNG in units of 1 / depth_scale metres (by default mm); 0 and 65535: no depth."),
    "labels": _file("One-channel or indexed PNG of instance numbers; 0 is background."),
    "intrinsics": {
        "type": "string",
        "description": "JSON: fx, fy, cx, cy in pixels and optionally depth_scale (units per metre); "
        "or a file of ROS, BOP, RealSense or Open3D, or a 3 x 3 matrix (JSON, YAML, text, NPY).",
    },
}
_INSTANCE = {"type": "integer", "minimum": 1, "description": "Label number of the object."}

FRAME_FORM = _form(_FRAME, "labels")
"""OpenAPI schema of the body of /v1/recognize. `decoding` parses it, since FastAPI writes large files to disk."""

WHY_FORM = _form({**_FRAME, "instance": _INSTANCE})
"""OpenAPI schema of the body of /v1/why."""

_ENROLLMENT: dict[str, Any] = {
    **_FRAME,
    "name": {"type": "string", "minLength": 1, "maxLength": 200, "description": "Name of the object."},
    "instance": _INSTANCE,
    "extend": {"type": "boolean", "description": "Add the view to an existing object, unless it has an equal one."},
    "replace": {"type": "boolean", "description": "Discard the views of an existing object."},
}

ENROLLMENT_FORM = _form(_ENROLLMENT, "extend", "replace")
"""OpenAPI schema of the body of POST /v1/objects."""

UNDO_FORM = _form({"generation": {"type": "integer", "minimum": 0, "description": "Generation after the change."}})
"""OpenAPI schema of the body of POST /v1/objects/undo."""


_CLOUDS = CloudsBody.model_json_schema()
_CLOUDS["properties"]["clouds"]["items"] = _CLOUDS.pop("$defs")["CloudBody"]  # References cannot be resolved.
ARRAYS = {"schema": {"type": "string", "format": "binary"}}
"""OpenAPI media type of npz files."""

CLOUDS_BODY = {"required": True, "content": {"application/json": {"schema": _CLOUDS}, NPZ: ARRAYS}}
"""OpenAPI schema of the body of /v1/describe."""
