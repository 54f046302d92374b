// SPDX-License-Identifier: Apache-2.0
#include "sim_osmesa.h"

#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "sim_inside.h"

#define PI 3.14159265358979323846
static const float GAIN = 1e6f;

extern const char sim_osmesa_shader[];  // sim_osmesa.glsl, put into the module where it is built

// The little of OpenGL that is used, by its own numbers, so that no header is needed.
enum {
    OSMESA_FORMAT = 0x22, OSMESA_PROFILE = 0x33, OSMESA_CORE_PROFILE = 0x34,
    OSMESA_CONTEXT_MAJOR_VERSION = 0x36, OSMESA_CONTEXT_MINOR_VERSION = 0x37,
    GL_TRIANGLES = 0x4, GL_UNSIGNED_BYTE = 0x1401, GL_FLOAT = 0x1406, GL_RGBA = 0x1908, GL_RGBA32F = 0x8814,
    GL_FRAGMENT_SHADER = 0x8B30, GL_VERTEX_SHADER = 0x8B31, GL_COMPILE_STATUS = 0x8B81,
    GL_LINK_STATUS = 0x8B82, GL_FRAMEBUFFER = 0x8D40, GL_RENDERBUFFER = 0x8D41,
    GL_COLOR_ATTACHMENT0 = 0x8CE0, GL_FRAMEBUFFER_COMPLETE = 0x8CD5
};

typedef void (*proc)(void);

struct gl {
    void *(*create_context)(const int *attributes, void *share);
    void (*destroy_context)(void *context);
    unsigned char (*make_current)(void *context, void *buffer, unsigned type, int width, int height);
    proc (*proc_address)(const char *name);
    unsigned (*CreateShader)(unsigned), (*CreateProgram)(void), (*GetError)(void);
    unsigned (*CheckFramebufferStatus)(unsigned);
    void (*ShaderSource)(unsigned, int, const char *const *, const int *);
    void (*CompileShader)(unsigned), (*LinkProgram)(unsigned), (*UseProgram)(unsigned);
    void (*GetShaderiv)(unsigned, unsigned, int *), (*GetProgramiv)(unsigned, unsigned, int *);
    void (*GetShaderInfoLog)(unsigned, int, int *, char *);
    void (*AttachShader)(unsigned, unsigned), (*BindVertexArray)(unsigned);
    void (*GenVertexArrays)(int, unsigned *), (*GenFramebuffers)(int, unsigned *);
    void (*GenRenderbuffers)(int, unsigned *);
    void (*BindFramebuffer)(unsigned, unsigned), (*BindRenderbuffer)(unsigned, unsigned);
    void (*RenderbufferStorage)(unsigned, unsigned, int, int);
    void (*FramebufferRenderbuffer)(unsigned, unsigned, unsigned, unsigned);
    int (*GetUniformLocation)(unsigned, const char *);
    void (*Uniform1fv)(int, int, const float *), (*Uniform3fv)(int, int, const float *);
    void (*Uniform4fv)(int, int, const float *);
    void (*UniformMatrix3fv)(int, int, unsigned char, const float *);
    void (*Viewport)(int, int, int, int), (*DrawArrays)(unsigned, int, int);
    void (*ReadPixels)(int, int, int, int, unsigned, unsigned, void *);
};

struct sim_osmesa {
    const struct sim_scene *scene;
    struct sim_camera camera;
    int n_emitters, emitters[SIM_MAX_PORTS];
    struct gl gl;
    void *context;
    unsigned program;
    unsigned char pixel[4];  // a context wants a buffer of its own; ours is the framebuffer object
};

static int fail(char *error, size_t bytes, const char *why) {
    if (error && bytes) snprintf(error, bytes, "%s", why);
    return -1;
}

// The library stays open for the life of the process: Mesa's threads do not survive being unloaded.
static void *library(void) {
    static const char *const names[] = {"libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"};
    for (size_t i = 0; i < sizeof names / sizeof *names; ++i) {
        void *found = dlopen(names[i], RTLD_NOW | RTLD_LOCAL);
        if (found) return found;
    }
    return NULL;
}

// ISO C has no cast from an object's address to a function's; POSIX says that their bytes are the same.
static int take(void *from, const char *name, proc *to) {
    void *at = dlsym(from, name);
    memcpy(to, &at, sizeof at);
    return at != NULL;
}

static int load(struct gl *gl, char *error, size_t bytes) {
    void *from = library();
    if (!from) return fail(error, bytes, "libOSMesa is not there");
    if (!take(from, "OSMesaCreateContextAttribs", (proc *)&gl->create_context) ||
        !take(from, "OSMesaDestroyContext", (proc *)&gl->destroy_context) ||
        !take(from, "OSMesaMakeCurrent", (proc *)&gl->make_current) ||
        !take(from, "OSMesaGetProcAddress", (proc *)&gl->proc_address))
        return fail(error, bytes, "libOSMesa is too old: it has no core profile");
    return 0;
}

static int load_functions(struct gl *gl) {
#define NAMED(name) {"gl" #name, (proc *)&gl->name}
    const struct {
        const char *name;
        proc *to;
    } wanted[] = {NAMED(CreateShader), NAMED(CreateProgram), NAMED(GetError), NAMED(CheckFramebufferStatus),
                  NAMED(ShaderSource), NAMED(CompileShader), NAMED(LinkProgram), NAMED(UseProgram),
                  NAMED(GetShaderiv), NAMED(GetProgramiv), NAMED(GetShaderInfoLog), NAMED(AttachShader),
                  NAMED(BindVertexArray), NAMED(GenVertexArrays), NAMED(GenFramebuffers),
                  NAMED(GenRenderbuffers), NAMED(BindFramebuffer), NAMED(BindRenderbuffer),
                  NAMED(RenderbufferStorage), NAMED(FramebufferRenderbuffer), NAMED(GetUniformLocation),
                  NAMED(Uniform1fv), NAMED(Uniform3fv), NAMED(Uniform4fv), NAMED(UniformMatrix3fv),
                  NAMED(Viewport), NAMED(DrawArrays), NAMED(ReadPixels)};
#undef NAMED
    for (size_t i = 0; i < sizeof wanted / sizeof *wanted; ++i)
        if (!(*wanted[i].to = gl->proc_address(wanted[i].name))) return -1;
    return 0;
}

static int compile(struct sim_osmesa *o, unsigned kind, const char *text, char *error, size_t bytes) {
    const struct gl *gl = &o->gl;
    unsigned shader = gl->CreateShader(kind);
    int good = 0;
    gl->ShaderSource(shader, 1, &text, NULL);
    gl->CompileShader(shader);
    gl->GetShaderiv(shader, GL_COMPILE_STATUS, &good);
    if (!good) {
        char log[160] = "";
        gl->GetShaderInfoLog(shader, sizeof log, NULL, log);
        return fail(error, bytes, log);
    }
    gl->AttachShader(o->program, shader);
    return 0;
}

static int start(struct sim_osmesa *o, char *error, size_t bytes) {
    const int attributes[] = {OSMESA_FORMAT, GL_RGBA, OSMESA_PROFILE, OSMESA_CORE_PROFILE,
                              OSMESA_CONTEXT_MAJOR_VERSION, 3, OSMESA_CONTEXT_MINOR_VERSION, 3, 0, 0};
    struct gl *gl = &o->gl;
    if (load(gl, error, bytes)) return -1;
    if (!(o->context = gl->create_context(attributes, NULL)) ||
        !gl->make_current(o->context, o->pixel, GL_UNSIGNED_BYTE, 1, 1) || load_functions(gl))
        return fail(error, bytes, "libOSMesa gives no OpenGL 3.3 core context");
    // One triangle that covers the picture.
    static const char corners[] =
        "#version 330 core\n"
        "void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, "
        "1.0); }\n";
    o->program = gl->CreateProgram();
    if (compile(o, GL_VERTEX_SHADER, corners, error, bytes) ||
        compile(o, GL_FRAGMENT_SHADER, sim_osmesa_shader, error, bytes))
        return -1;
    int good = 0, n = o->camera.pixels;
    unsigned vertices, frame, colour;
    gl->LinkProgram(o->program);
    gl->GetProgramiv(o->program, GL_LINK_STATUS, &good);
    gl->UseProgram(o->program);
    gl->GenVertexArrays(1, &vertices);
    gl->BindVertexArray(vertices);
    gl->GenFramebuffers(1, &frame);
    gl->BindFramebuffer(GL_FRAMEBUFFER, frame);
    gl->GenRenderbuffers(1, &colour);
    gl->BindRenderbuffer(GL_RENDERBUFFER, colour);
    gl->RenderbufferStorage(GL_RENDERBUFFER, GL_RGBA32F, n, n);
    gl->FramebufferRenderbuffer(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_RENDERBUFFER, colour);
    gl->Viewport(0, 0, n, n);
    if (!good || gl->CheckFramebufferStatus(GL_FRAMEBUFFER) != GL_FRAMEBUFFER_COMPLETE || gl->GetError())
        return fail(error, bytes, "OpenGL gives no framebuffer of 32-bit floats of this size");
    gl->make_current(NULL, NULL, 0, 0, 0);
    return 0;
}

struct sim_osmesa *sim_osmesa_open(const struct sim_scene *scene, int sensor, const int *emitters,
                                   int n_emitters, int pixels, double half_width_sigmas, char *error,
                                   size_t error_bytes) {
    struct sim_camera camera;
    if (sim_camera_set(&camera, scene, sensor, emitters, n_emitters, pixels, half_width_sigmas, error,
                       error_bytes))
        return NULL;
    struct sim_osmesa *o = calloc(1, sizeof *o);
    if (!o) {
        fail(error, error_bytes, "out of memory");
        return NULL;
    }
    o->scene = scene;
    o->camera = camera;
    o->n_emitters = n_emitters;
    memcpy(o->emitters, emitters, (size_t)n_emitters * sizeof *emitters);
    if (start(o, error, error_bytes)) {
        sim_osmesa_close(o);
        return NULL;
    }
    return o;
}

void sim_osmesa_close(struct sim_osmesa *o) {
    if (!o) return;
    if (o->context) o->gl.destroy_context(o->context);
    free(o);
}

static void set(const struct sim_osmesa *o, const char *name, int count, const double *value) {
    float f[4];
    int at = o->gl.GetUniformLocation(o->program, name);
    for (int k = 0; k < count; ++k) f[k] = (float)value[k];
    if (count == 1) o->gl.Uniform1fv(at, 1, f);
    else if (count == 3) o->gl.Uniform3fv(at, 1, f);
    else o->gl.Uniform4fv(at, 1, f);
}

static void set_person(const struct sim_osmesa *o, const struct sim_lid *lid, double pupil_mm) {
    const struct sim_person *p = &o->scene->person;
    const struct sim_eye *eye = &o->scene->eye;
    const struct {
        const char *name;
        double value;
    } one[] = {{"gain", GAIN}, {"cornea_radius", eye->radius}, {"cornea_p", eye->p}, {"apex", eye->apex},
               {"globe", eye->globe}, {"blend", eye->blend}, {"limbus", eye->limbus}, {"haze", eye->haze},
               {"iris_z", eye->iris_z}, {"index", eye->index}, {"pupil_radius", pupil_mm / 2},
               {"lid_radius", p->lid_radius_mm}, {"skin_canthus", (p->canthus_deg + 4) * SIM_RADIANS}};
    for (size_t i = 0; i < sizeof one / sizeof *one; ++i) set(o, one[i].name, 1, &one[i].value);
    const double albedo[3] = {p->albedo_skin / PI, p->albedo_sclera / PI, p->albedo_iris / PI};
    const double relief[3] = {p->brow_mm, p->nose_mm, p->cheek_mm};
    const double curves[4] = {lid->upper, lid->lower, lid->half, lid->tilt};
    const double margin[4] = {lid->thickness, lid->softness, lid->lash_length, lid->lash_opacity};
    set(o, "albedo", 3, albedo);
    set(o, "relief_mm", 3, relief);
    set(o, "lid", 4, curves);
    set(o, "margin", 4, margin);
}

static void set_camera(const struct sim_osmesa *o) {
    const struct sim_camera *c = &o->camera;
    set(o, "camera", 3, c->position);
    set(o, "aim", 3, c->aim);
    set(o, "right", 3, c->right);
    set(o, "up", 3, c->up);
    set(o, "half_width", 1, &c->half);
    set(o, "pitch", 1, &c->pitch);
    set(o, "camera_radius", 1, &o->scene->sites[c->site].radius);
}

int sim_osmesa_render(struct sim_osmesa *o, double azimuth_deg, double elevation_deg, double pupil_mm,
                      double lid_opening, float *radiance) {
    const struct sim_scene *scene = o->scene;
    const struct gl *gl = &o->gl;
    size_t n = (size_t)o->camera.pixels;
    double axes[9];
    float columns[9];
    struct sim_lid lid;
    if (sim_image_bad_state(scene, azimuth_deg, elevation_deg, pupil_mm, lid_opening)) return -1;
    if (!gl->make_current(o->context, o->pixel, GL_UNSIGNED_BYTE, 1, 1)) return -2;
    sim_eye_orient(&scene->eye, azimuth_deg, elevation_deg, axes);
    sim_lid_pose(&lid, &scene->person, elevation_deg, lid_opening);
    for (int k = 0; k < 9; ++k) columns[k] = (float)axes[k];
    gl->UniformMatrix3fv(gl->GetUniformLocation(o->program, "eye_axes"), 1, 1, columns);
    set_person(o, &lid, pupil_mm);
    set_camera(o);
    for (int e = 0; e < o->n_emitters; ++e) {
        const struct sim_window *beam = &scene->emitters[o->emitters[e]];
        double rough = scene->person.roughness, lobe2 = rough * rough;
        lobe2 += sim_image_widen(scene, axes, beam->site) + sim_image_widen(scene, axes, o->camera.site);
        set(o, "lamp", 3, scene->sites[beam->site].position);
        set(o, "lamp_aim", 3, beam->aim);
        set(o, "lamp_per_tan2", 1, &beam->per_tan2);
        set(o, "lamp_radius", 1, &scene->sites[beam->site].radius);
        set(o, "lobe2", 1, &lobe2);
        gl->DrawArrays(GL_TRIANGLES, 0, 3);
        gl->ReadPixels(0, 0, (int)n, (int)n, GL_RGBA, GL_FLOAT, radiance + (size_t)e * n * n * 4);
    }
    for (size_t i = 0; i < (size_t)o->n_emitters * n * n * 4; ++i) radiance[i] /= GAIN;
    unsigned error = gl->GetError();
    gl->make_current(NULL, NULL, 0, 0, 0);  // another thread may be next
    return error ? -2 : 0;
}
