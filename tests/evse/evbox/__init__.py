"""EVBox: pure functions, a ChargePoint in simulated time, and a real wire."""
