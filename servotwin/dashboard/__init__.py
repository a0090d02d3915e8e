"""What the dashboard shows: rows of the fleet, series of a machine, decimated windows, and the page's own files."""
