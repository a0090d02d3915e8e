"""Knowledge from windows across time: gap and wear, and the numbers of machine and motor; `wear.Wear` is the entry."""
