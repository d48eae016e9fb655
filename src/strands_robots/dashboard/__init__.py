"""The operator's page: every robot in a browser, and a STOP for all of them."""
