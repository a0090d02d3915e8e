"""The link between edge and twin: outbox, session, simulated link."""
