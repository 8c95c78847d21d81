"""Client methods: pictures."""
# Written by `make client` from service/features/pictures/routes.py.

from .. import models
from ..calls import Call, model, single_request
from ..encoding import BINARY, path_of
from ..retrying import Repeat


class PicturesMethods:
    """Methods for the routes of `service/features/pictures/routes.py` of the service."""

    @single_request
    def solve_picture(
        self,
        picture: bytes,
        *,
        spacecraft: str | None = None,
        field_of_view_deg: float | None = None,
        lens: str | None = None,
        pixel_ratio: float | None = None,
        image: str | None = None,
        overlay: bool = False,
    ) -> Call[models.Picture]:
        """Find the stars, the attitude and the lens of a picture of any camera, and record nothing.

        - `picture`: The content of the file.
        - `spacecraft`: Whose camera took it. Default: a camera that the service does not know.
        - `field_of_view_deg`: Along the longer side; may be wrong by a quarter. From 120: with
          `lens`.
        - `lens`: How the lens projects the sky. Default: whatever fits.
        - `pixel_ratio`: Width of a pixel over its height. Default: from the FITS header, else 1.
        - `image`: As of a frame.
        - `overlay`: Whether the answer holds the picture with the stars.
        """
        path = path_of("pictures")
        query = {
            "spacecraft": spacecraft,
            "field_of_view_deg": field_of_view_deg,
            "lens": lens,
            "pixel_ratio": pixel_ratio,
            "image": image,
            "overlay": overlay,
        }
        return Call(
            model(models.Picture),
            "POST",
            path,
            query=query,
            content=picture,
            headers=BINARY,
            repeat=Repeat.ALWAYS,
        )
