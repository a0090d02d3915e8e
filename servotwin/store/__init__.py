"""Database of messages, estimates, versions and receipts; SQLite by default, PostgreSQL by URL."""
