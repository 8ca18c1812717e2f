"""Studies that compare: methods of the paper, hidden effects, closed loop, speed against peers."""
