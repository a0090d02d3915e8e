"""What the command line's commands take, group by group. Each imports what it does when it runs."""
