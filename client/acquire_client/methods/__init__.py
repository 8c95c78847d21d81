"""Client methods that send one request each."""
# Written by `make client` from the routes of the service.

from .alarms import AlarmsMethods
from .batches import BatchesMethods
from .calibration import CalibrationMethods
from .definitive import DefinitiveMethods
from .pictures import PicturesMethods
from .runs import RunsMethods
from .spacecraft import SpacecraftMethods
from .tokens import TokensMethods
from .tracks import TracksMethods


class Methods(
    AlarmsMethods,
    BatchesMethods,
    CalibrationMethods,
    DefinitiveMethods,
    PicturesMethods,
    RunsMethods,
    SpacecraftMethods,
    TokensMethods,
    TracksMethods,
):
    """All methods that send one request each.

    `who` signs a change while access is open; with a token, its name does.
    """
