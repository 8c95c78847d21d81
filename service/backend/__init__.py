"""The operations in a process of their own, and what stands for them where HTTP is served.

    front (uvicorn, pages, reads)  ── asked ──►  backend (identify, solve, record)
                                   ◄─ told ───

Two processes have two interpreters: a batch is computed while another is being
read from its client, and neither waits for the other's lock.
"""
