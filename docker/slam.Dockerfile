# The robot: cohdc predict, slam, evaluate and report, on x86-64 and aarch64. No torch.
#   docker build -f docker/slam.Dockerfile -t cohdc-slam .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" cohdc-slam slam --sequence walk --out runs/walk
# .ci/check_docker runs the install steps without docker.
FROM python:3.11-slim
RUN useradd --create-home cohdc && install -d -o cohdc /data
WORKDIR /opt/cohdc
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY cohdc_train cohdc_train
COPY configs configs
RUN python3 -m pip install --no-cache-dir -c constraints.txt .
# Caches of matplotlib go where any --user may write.
ENV HOME=/tmp
USER cohdc
RUN cohdc env && cohdc slam --help > /dev/null
WORKDIR /data
ENTRYPOINT ["cohdc"]
CMD ["--help"]
