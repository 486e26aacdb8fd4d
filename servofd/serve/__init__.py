"""A local page: drop logs on it, see their verdicts; the web server is Starlette on uvicorn (``servofd[serve]``)."""
