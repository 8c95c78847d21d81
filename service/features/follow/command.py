"""Command `acquire follow`: submit telemetry from a NATS JetStream stream."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli import arguments
from service.errors import BadInput, Fault, shown_value

if TYPE_CHECKING:
    from service.features.follow.follower import Metrics

DEFAULT_CONCURRENCY = 16


def add(commands: Any) -> None:
    """Declare the command `follow` and its options."""
    parser = arguments.add_command(commands, "follow", run, first="--url --answers --until-empty")
    parser.add_argument("source", metavar="nats://HOST/STREAM", help="or tls://HOST/STREAM")
    parser.add_argument(
        "--consumer",
        required=True,
        metavar="NAME",
        help="the durable consumer; made where the stream has none of that name",
    )
    parser.add_argument("--url", help=arguments.SERVICE)
    parser.add_argument(
        "--refusals",
        metavar="SUBJECT",
        help="where refused messages go with their problem; default: acquire.refused.STREAM",
    )
    parser.add_argument("--answers", metavar="SUBJECT", help="where answers go; default: nowhere")
    parser.add_argument(
        "--credentials", type=Path, metavar="FILE", help="credentials of NATS (.creds)"
    )
    parser.add_argument(
        "--authority",
        type=Path,
        metavar="FILE",
        help="CA certificate (PEM) that the NATS server's certificate is checked with",
    )
    parser.add_argument(
        "--concurrency",
        type=arguments.count,
        default=DEFAULT_CONCURRENCY,
        metavar="N",
        help="messages at work together (default 16); 1 keeps their order",
    )
    parser.add_argument(
        "--metrics-port",
        type=arguments.count,
        metavar="PORT",
        help="serve metrics on this loopback port",
    )
    parser.add_argument(
        "--until-empty", action="store_true", help="end when every message is settled"
    )
    arguments.add_json(parser, "the counts")


def run(parsed: Namespace) -> int:
    """Send the messages of a NATS stream to the service: each is a batch or a gyro block, and is
    acknowledged once it is recorded.  Several followers of one consumer share the work.

    acquire follow nats://127.0.0.1:4222/TELEMETRY --consumer acquire
    acquire follow tls://bus.example/TELEMETRY --consumer acquire --credentials acquire.creds
    acquire follow nats://127.0.0.1/TELEMETRY --consumer acquire --answers attitudes
    """
    import asyncio
    import signal

    from service.extras import require_extra

    require_extra("nats", "nats", "SOURCE", "nats")
    from acquire_client import AsyncClient
    from prometheus_client import start_http_server

    from service.features.follow.follower import Follower, Metrics
    from service.features.follow.over_http import OverHttp
    from service.features.follow.source import Source, refusals_of, server_and_stream
    from service.replay.over_http import checked_url, translated

    try:
        servers, stream = server_and_stream(parsed.source)
    except ValueError as error:
        # No address in the message: it may contain a password.
        raise BadInput(Fault("SOURCE", str(error))) from None
    source = Source(
        servers,
        stream,
        parsed.consumer,
        parsed.refusals or refusals_of(stream),
        parsed.answers,
        _existing_file(parsed.credentials, "--credentials"),
        _existing_file(parsed.authority, "--authority"),
        parsed.concurrency,
    )
    url, metrics = checked_url(arguments.service_url(parsed)), Metrics()
    token = arguments.settings_of(parsed).token

    async def follow() -> None:
        async with AsyncClient(url, token=token) as client:
            submit = OverHttp(client)
            await submit.require_scope()
            follower = Follower(source, submit, metrics, _show)
            loop = asyncio.get_running_loop()
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, follower.stop)
            try:
                await follower.run(parsed.until_empty)
            except ExceptionGroup as errors:
                # Of several simultaneous messages one error explains the end.
                raise errors.exceptions[0] from None

    if parsed.metrics_port is not None:
        start_http_server(parsed.metrics_port, "127.0.0.1", metrics.registry)
    with translated(url):
        asyncio.run(follow())
    if parsed.json:
        arguments.print_json(metrics.counts)
    else:
        print(_text(metrics))
    return 1 if metrics.counts["refused"] else 0


def _show(metrics: "Metrics") -> None:
    print(_text(metrics), file=sys.stderr, flush=True)


def _text(metrics: "Metrics") -> str:
    counts = ", ".join(f"{number:,} {name}" for name, number in metrics.counts.items())
    return f"{counts}; {metrics.lag:,} to come"


def _existing_file(file: Path | None, name: str) -> Path | None:
    if file is not None and not file.is_file():
        raise BadInput(Fault(name, "is not there, or is no file", shown_value(str(file))))
    return file
