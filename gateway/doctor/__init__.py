"""``rtc3d-gateway doctor``: looks layer by layer for what keeps data from flowing, and says what to do."""
