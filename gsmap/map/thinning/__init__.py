"""Store superseded captures in compact form."""
