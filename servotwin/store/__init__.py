"""The twin's evidence on disk: messages, estimates, versions, receipts; SQLite by default, PostgreSQL by URL."""
