"""A client of the attitude service: submit batches, read results, follow events.

It imports nothing of the service, and is built alone.
"""

# `X as X` tells type checkers that a name is public.
from . import models as models
from ._async.client import AsyncClient as AsyncClient
from ._async.client import AsyncEvents as AsyncEvents
from ._async.connection import AsyncItems as AsyncItems
from ._sync.client import Client as Client
from ._sync.client import Events as Events
from ._sync.connection import Items as Items
from .errors import BadInput as BadInput
from .errors import Busy as Busy
from .errors import ClientError as ClientError
from .errors import Conflict as Conflict
from .errors import EventsLost as EventsLost
from .errors import Forbidden as Forbidden
from .errors import InvalidArgument as InvalidArgument
from .errors import KeyReused as KeyReused
from .errors import NoAnswer as NoAnswer
from .errors import NotAvailable as NotAvailable
from .errors import NotFound as NotFound
from .errors import PackageMissing as PackageMissing
from .errors import Problem as Problem
from .errors import RateLimited as RateLimited
from .errors import ReplayEnded as ReplayEnded
from .errors import ServiceFailed as ServiceFailed
from .errors import Unauthenticated as Unauthenticated
from .errors import UnexpectedAnswer as UnexpectedAnswer
from .errors import WrongState as WrongState
from .event_lines import Event as Event
from .event_lines import OtherEvent as OtherEvent
from .events import AdoptedEvent as AdoptedEvent
from .events import AlarmEvent as AlarmEvent
from .events import AnnotationEvent as AnnotationEvent
from .events import BatchesEvent as BatchesEvent
from .events import CalibrationEvent as CalibrationEvent
from .events import GyroEvent as GyroEvent
from .events import LimitEvent as LimitEvent
from .events import ReplayEvent as ReplayEvent
from .events import TrackingEvent as TrackingEvent
from .operations import BatchOutcome as BatchOutcome
from .operations import RecordedAnswer as RecordedAnswer
from .retrying import Repeat as Repeat

__version__ = "0.2.0"
