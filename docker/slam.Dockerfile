# The robot: cohdc predict, slam and evaluate. No torch. .ci/check_docker runs the install steps without docker.
#   docker build -f docker/slam.Dockerfile -t cohdc-slam .
#   docker run --rm -v "$PWD/data:/data" cohdc-slam slam --sequence /data/rgbd_dataset_freiburg3_walking_xyz --out /data/run
FROM python:3.11-slim
WORKDIR /opt/cohdc
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY cohdc_train cohdc_train
COPY configs configs
RUN python3 -m pip install --no-cache-dir -c constraints.txt .
RUN cohdc env && cohdc slam --help > /dev/null
WORKDIR /data
ENTRYPOINT ["cohdc"]
CMD ["--help"]
