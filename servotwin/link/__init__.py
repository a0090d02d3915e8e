"""The link between edge and twin: outbox, session, seals, transports, and a simulated link in virtual time."""
