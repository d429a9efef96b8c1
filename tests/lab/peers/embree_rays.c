// Loops over rays in Embree 4, timed by the thread's CPU clock. Built and called by embree_rays.py; the
// declarations restate the part of Embree's C interface that is used, since the wheel has no headers.
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

typedef void *Handle;
typedef struct {
  float org[3], tnear, dir[3], time, tfar;
  unsigned mask, id, flags;
} __attribute__((aligned(16))) Ray;
typedef struct {
  Ray ray;
  float ng[3], u, v;
  unsigned prim, geom, inst, inst_prim;
} __attribute__((aligned(16))) RayHit;
typedef struct {
  float org[3][16], tnear[16], dir[3][16], time[16], tfar[16];
  unsigned mask[16], id[16], flags[16];
} __attribute__((aligned(64))) Ray16;
typedef struct {
  Ray16 ray;
  float ng[3][16], u[16], v[16];
  unsigned prim[16], geom[16], inst[16], inst_prim[16];
} __attribute__((aligned(64))) RayHit16;

Handle rtcNewDevice(const char *);
Handle rtcNewScene(Handle);
Handle rtcNewGeometry(Handle, int);
void *rtcSetNewGeometryBuffer(Handle, int, unsigned, int, size_t, size_t);
void rtcCommitGeometry(Handle);
unsigned rtcAttachGeometry(Handle, Handle);
void rtcSetSceneFlags(Handle, int);
void rtcCommitScene(Handle);
void rtcIntersect1(Handle, RayHit *, void *);
void rtcOccluded1(Handle, Ray *, void *);
void rtcIntersect16(const int *, Handle, RayHit16 *, void *);
void rtcOccluded16(const int *, Handle, Ray16 *, void *);

// RTCIntersectArguments and RTCOccludedArguments begin alike; the rest stays zero.
typedef struct {
  int flags, features;
  void *rest[8];
} Arguments;

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}

// A committed scene of n triangles, nine floats each. robust: RTC_SCENE_FLAG_ROBUST.
Handle make_scene(const float *triangles, unsigned n, int robust) {
  Handle device = rtcNewDevice("threads=1");
  Handle scene = rtcNewScene(device), mesh = rtcNewGeometry(device, 0);
  float *v = rtcSetNewGeometryBuffer(mesh, 1, 0, 0x9003, 12, 3 * (size_t)n);
  unsigned *i = rtcSetNewGeometryBuffer(mesh, 0, 0, 0x5003, 12, n);
  memcpy(v, triangles, 36 * (size_t)n);
  for (unsigned k = 0; k < 3 * n; k++) i[k] = k;
  rtcCommitGeometry(mesh);
  rtcAttachGeometry(scene, mesh);
  if (robust) rtcSetSceneFlags(scene, 4);
  rtcCommitScene(scene);
  return scene;
}

// CPU seconds for n rays (origin, direction, limit), nearest hit or any; single or coherent packets of 16.
// *blocked: how many rays met something. Rays are set up from the array inside the timed loop, as a
// renderer would.
double trace(Handle scene, const float *rays, unsigned n, int any, int packets, unsigned *blocked) {
  Arguments coherent = {1 << 16, -1, {0}};
  unsigned hits = 0;
  double start = now();
  if (!packets) {
    for (unsigned k = 0; k < n; k++) {
      const float *r = rays + 7 * (size_t)k;
      RayHit h;
      memcpy(h.ray.org, r, 12);
      memcpy(h.ray.dir, r + 3, 12);
      h.ray.tnear = 0, h.ray.tfar = r[6], h.ray.time = 0;
      h.ray.mask = ~0u, h.ray.id = 0, h.ray.flags = 0;
      if (any) {
        rtcOccluded1(scene, &h.ray, 0);
        hits += h.ray.tfar < 0;
      } else {
        h.geom = h.prim = h.inst = ~0u;
        rtcIntersect1(scene, &h, 0);
        hits += h.geom != ~0u;
      }
    }
  } else {
    for (unsigned k = 0; k < n; k += 16) {
      RayHit16 h;
      int valid[16] __attribute__((aligned(64)));
      for (unsigned l = 0; l < 16; l++) {
        const float *r = rays + 7 * (size_t)(k + l < n ? k + l : n - 1);
        valid[l] = k + l < n ? -1 : 0;
        for (int a = 0; a < 3; a++) h.ray.org[a][l] = r[a], h.ray.dir[a][l] = r[3 + a];
        h.ray.tnear[l] = 0, h.ray.tfar[l] = r[6], h.ray.time[l] = 0;
        h.ray.mask[l] = ~0u, h.ray.id[l] = 0, h.ray.flags[l] = 0;
        h.geom[l] = h.prim[l] = h.inst[l] = ~0u;
      }
      if (any)
        rtcOccluded16(valid, scene, &h.ray, &coherent);
      else
        rtcIntersect16(valid, scene, &h, &coherent);
      for (unsigned l = 0; l < 16; l++)
        hits += valid[l] && (any ? h.ray.tfar[l] < 0 : h.geom[l] != ~0u);
    }
  }
  double seconds = now() - start;
  *blocked = hits;
  return seconds;
}
