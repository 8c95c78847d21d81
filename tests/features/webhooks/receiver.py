"""A receiver of webhooks as a program: it checks each signature and writes down what came.

    python -m tests.features.webhooks.receiver PORT FILE SECRET

A line of JSON for each request, written before the answer: killed at any moment, it has not
said yes to what it did not write.  The signatures are checked by the standard's own library.
"""

import json
import os
import sys
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from standardwebhooks.webhooks import Webhook, WebhookVerificationError

WORK_S = 0.03


def handler_of(file, secret):
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self):
            body = self.rfile.read(int(self.headers["content-length"]))
            try:
                told = Webhook(secret).verify(body, dict(self.headers.items()))
                verified = True
            except WebhookVerificationError:
                told, verified = json.loads(body), False
            line = {"id": self.headers["webhook-id"], "verified": verified, "told": told}
            os.write(file, json.dumps(line).encode() + b"\n")
            # Killed now, it has the event and has not said so.
            time.sleep(WORK_S)
            self.send_response(204 if verified else 400)
            self.end_headers()

        def log_message(self, *_):
            pass

    return Handler


def main(port, path, secret):
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    with ThreadingHTTPServer(("127.0.0.1", int(port)), handler_of(file, secret)) as server:
        print("ready", flush=True)
        server.serve_forever()


if __name__ == "__main__":
    main(*sys.argv[1:])
