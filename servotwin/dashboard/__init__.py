"""Contents of the dashboard: rows of the fleet, series of a machine, decimated windows, and the page's own files."""
