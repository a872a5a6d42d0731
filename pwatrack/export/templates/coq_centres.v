   The plant is the one at the centres of the balls that its numbers lie in: of the others there
   nothing is proved here ('pwatrack verify' does that).
