"""SmartEVSE v2: Modbus RTU on RS-485."""
