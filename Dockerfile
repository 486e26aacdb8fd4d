# servofd with everything, as a user of its own:
#   docker build -t servofd .
#   docker run --rm -v "$PWD/flights:/flights" servofd /flights --no-open
#   docker run --rm -v "$PWD/flights:/flights" -p 127.0.0.1:8787:8787 servofd serve --folder /flights --host 0.0.0.0 --no-open
FROM python:3.12-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY configs configs
COPY logparsers logparsers
COPY servofd servofd
RUN python -m venv /opt/servofd && /opt/servofd/bin/pip install --no-cache-dir ".[all]"

FROM python:3.12-slim
COPY --from=build /opt/servofd /opt/servofd
# Compiled kernels are kept where the user may write.
ENV PATH=/opt/servofd/bin:$PATH PYTHONUNBUFFERED=1 NUMBA_CACHE_DIR=/home/servofd/.cache/numba
RUN useradd --create-home --uid 1000 servofd
USER servofd
WORKDIR /flights
EXPOSE 8787
ENTRYPOINT ["servofd"]
CMD ["--help"]
