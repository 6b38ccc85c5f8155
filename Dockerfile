# planner without a display: docker build -t planner . && docker run --rm -v "$PWD:/work" planner run two-link
FROM python:3.12-slim-bookworm

# OSMesa draws films in software; MuJoCo looks for it by this variable.
RUN apt-get update && apt-get install -y --no-install-recommends libosmesa6 && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=osmesa

COPY . /src
RUN pip install --no-cache-dir /src && rm -rf /src

# Kernels are compiled at the first run, for the processor that runs them: keep them in a volume at /root/.cache.
VOLUME /root/.cache
WORKDIR /work
ENTRYPOINT ["planner"]
