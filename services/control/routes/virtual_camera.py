"""Virtual camera of a stream, the viewpoint of the picture `orbit`."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request

from services.control.auth.guard import new_router, requires
from services.control.routes.streams import streams_of
from services.settings import ResourceName

router = new_router("streams")


class VirtualCamera(BaseModel):
    """Position of the virtual camera relative to the endoscope, orbiting the point at the centre of
    its picture."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"azimuth_deg": 20, "elevation_deg": 10}]}
    )
    azimuth_deg: float = Field(0.0, ge=-75, le=75, description="To the right.")
    elevation_deg: float = Field(0.0, ge=-75, le=75, description="Upwards.")
    zoom: float = Field(1.0, ge=0.25, le=4, description="How many times closer.")


@router.put("/streams/{name}/camera")
@requires("viewer", scope="stream")
async def turn_virtual_camera(request: Request, name: ResourceName, wanted: VirtualCamera) -> VirtualCamera:
    """Move the stream's virtual camera, which all viewers share; the last request wins. Nothing
    else changes, and the audit log has no entry. 409 if the stream is stopped or just starting."""
    return VirtualCamera.model_validate(await streams_of(request).set_camera(name, wanted.model_dump()))
