"""Registration of space packets as an input format."""

from service.observations.input_formats import InputFormat

INPUT_FORMATS = {
    "packets": InputFormat(
        "CCSDS space packets",
        "batches and gyro blocks",
        "--packets FILE --xtce FILE",
        "The XTCE file says where a parameter lies in a packet and how it is calibrated, the table "
        "[packets] of\nthe mission which parameters fill a batch.  Needs the extra `packets`.",
        suffixes=(".tar",),
        media_types=("application/x-tar",),
        uploaded="Files of CCSDS space packets, and one XTCE file (.xml or .xtce).",
    ),
}
