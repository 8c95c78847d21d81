"""Sends bodies that are far too large, several at once, from a process of its own.

    python -m tests.web.flood PORT declared|chunked BODIES BYTES

Prints one JSON line: how many bytes were taken off, and the first line of every
answer that came.  Its priority is the lowest: what it costs to send is not to be
mistaken for what it costs to be sent to.
"""

import json
import os
import socket
import sys
import threading

PIECE = b" " * 65536
HEAD = "POST /api/v1/batches HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"


def main(port, how, bodies, length):
    os.nice(19)
    passed, told = [], []
    declared = how == "declared"

    def send():
        with socket.create_connection(("127.0.0.1", int(port)), timeout=300) as connection:
            framing = f"Content-Length: {length}" if declared else "Transfer-Encoding: chunked"
            connection.sendall(f"{HEAD}{framing}\r\n\r\n".encode())
            pieces = 0
            try:
                for _ in range(int(length) // len(PIECE)):
                    connection.sendall(PIECE if declared else b"10000\r\n" + PIECE + b"\r\n")
                    pieces += 1
                told.append(connection.recv(1000).decode().split("\r\n")[0])
            except ConnectionError:
                # Cut off, after its answer, which may be lost with the connection.
                pass
            passed.append(pieces * len(PIECE))

    senders = [threading.Thread(target=send) for _ in range(int(bodies))]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join()
    print(json.dumps({"passed": sum(passed), "told": told}))


if __name__ == "__main__":
    main(*sys.argv[1:])
