// The few types of Unity that the package uses, as Unity's reference describes them, for tests without Unity.
using System;
using System.Collections;
using System.Collections.Generic;
using System.Globalization;
using System.Reflection;
using System.Text;

namespace UnityEngine
{
    public sealed class ExecuteAlways : Attribute { }
    public sealed class DisallowMultipleComponent : Attribute { }
    public sealed class DefaultExecutionOrder : Attribute { public DefaultExecutionOrder(int order) { } }
    public sealed class RequireComponent : Attribute { public RequireComponent(Type type) { } }
    public sealed class AddComponentMenu : Attribute { public AddComponentMenu(string path) { } }
    public sealed class TooltipAttribute : Attribute { public TooltipAttribute(string text) { } }
    public sealed class RangeAttribute : Attribute { public RangeAttribute(float least, float most) { } }

    public class Object { public string name = ""; }
    public class Component : Object
    {
        public Dictionary<Type, Component> beside = new Dictionary<Type, Component>();
        public T GetComponent<T>() where T : Component { return (T)beside[typeof(T)]; }
    }
    public class MonoBehaviour : Component { }
    public class TextAsset : Object { public string text; }
    public static class Debug { public static void LogError(object message, Object context) { Console.Error.WriteLine(message); } }
    public static class Mathf
    {
        public static float Clamp01(float x) { return x < 0 ? 0 : x > 1 ? 1 : x; }
        public static float Pow(float x, float power) { return (float)Math.Pow(x, power); }
    }

    public struct Vector3
    {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
        public float this[int k] { get { return k == 0 ? x : k == 1 ? y : k == 2 ? z : throw new IndexOutOfRangeException(); } }
        public static Vector3 operator +(Vector3 a, Vector3 b) { return new Vector3(a.x + b.x, a.y + b.y, a.z + b.z); }
        public static Vector3 operator /(Vector3 a, float by) { return new Vector3(a.x / by, a.y / by, a.z / by); }
    }

    public struct Vector4
    {
        public float x, y, z, w;
        public static implicit operator Vector3(Vector4 v) { return new Vector3(v.x, v.y, v.z); }
    }

    public struct Quaternion
    {
        public float x, y, z, w;
        public Quaternion(float x, float y, float z, float w) { this.x = x; this.y = y; this.z = z; this.w = w; }
        public float this[int k] { get { return k == 0 ? x : k == 1 ? y : k == 2 ? z : k == 3 ? w : throw new IndexOutOfRangeException(); } }
        public static Quaternion Inverse(Quaternion q) { return new Quaternion(-q.x, -q.y, -q.z, q.w); }
        public static Quaternion operator *(Quaternion a, Quaternion b)
        {
            return new Quaternion(
                a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y, a.w * b.y + a.y * b.w + a.z * b.x - a.x * b.z,
                a.w * b.z + a.z * b.w + a.x * b.y - a.y * b.x, a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z);
        }
    }

    public struct Matrix4x4
    {
        public float m00, m01, m02, m03, m10, m11, m12, m13, m20, m21, m22, m23; // the last row is 0 0 0 1 here
        public Vector4 GetColumn(int k)
        {
            if (k != 3) throw new NotSupportedException();
            return new Vector4 { x = m03, y = m13, z = m23, w = 1 };
        }
        public Matrix4x4 inverse
        {
            get
            {
                double det = m00 * (double)(m11 * m22 - m12 * m21) - m01 * (double)(m10 * m22 - m12 * m20) + m02 * (double)(m10 * m21 - m11 * m20);
                var i = new Matrix4x4
                {
                    m00 = (float)((m11 * m22 - m12 * m21) / det), m01 = (float)((m02 * m21 - m01 * m22) / det), m02 = (float)((m01 * m12 - m02 * m11) / det),
                    m10 = (float)((m12 * m20 - m10 * m22) / det), m11 = (float)((m00 * m22 - m02 * m20) / det), m12 = (float)((m02 * m10 - m00 * m12) / det),
                    m20 = (float)((m10 * m21 - m11 * m20) / det), m21 = (float)((m01 * m20 - m00 * m21) / det), m22 = (float)((m00 * m11 - m01 * m10) / det),
                };
                i.m03 = -(i.m00 * m03 + i.m01 * m13 + i.m02 * m23);
                i.m13 = -(i.m10 * m03 + i.m11 * m13 + i.m12 * m23);
                i.m23 = -(i.m20 * m03 + i.m21 * m13 + i.m22 * m23);
                return i;
            }
        }
        public Quaternion rotation
        {
            get
            {
                float s = (float)Math.Sqrt(m00 * m00 + m10 * m10 + m20 * m20); // of one scale in all directions
                float xx = m00 / s, yy = m11 / s, zz = m22 / s;
                var q = new Quaternion(
                    Half(1 + xx - yy - zz), Half(1 - xx + yy - zz), Half(1 - xx - yy + zz), Half(1 + xx + yy + zz));
                if (q.w > 0.1f) return new Quaternion((m21 - m12) / s / (4 * q.w), (m02 - m20) / s / (4 * q.w), (m10 - m01) / s / (4 * q.w), q.w);
                if (q.x > 0.5f) return new Quaternion(q.x, (m01 + m10) / s / (4 * q.x), (m02 + m20) / s / (4 * q.x), (m21 - m12) / s / (4 * q.x));
                if (q.y > 0.5f) return new Quaternion((m01 + m10) / s / (4 * q.y), q.y, (m12 + m21) / s / (4 * q.y), (m02 - m20) / s / (4 * q.y));
                return new Quaternion((m02 + m20) / s / (4 * q.z), (m12 + m21) / s / (4 * q.z), q.z, (m10 - m01) / s / (4 * q.z));
            }
        }
        static float Half(float x) { return 0.5f * (float)Math.Sqrt(Math.Max(0, x)); }
    }

    public class Transform : Component
    {
        public Transform parent;
        public Quaternion localRotation = new Quaternion(0, 0, 0, 1);
        public Quaternion rotation { get { return parent == null ? localRotation : parent.rotation * localRotation; } }
    }

    public class Mesh : Object
    {
        public Matrix4x4[] bindposes;
        public string[] shapeNames;
        public float fullWeight;
        public int blendShapeCount { get { return shapeNames.Length; } }
        public string GetBlendShapeName(int k) { return shapeNames[k]; }
        public int GetBlendShapeFrameCount(int k) { return 1; }
        public float GetBlendShapeFrameWeight(int k, int frame) { if (frame != 0) throw new IndexOutOfRangeException(); return fullWeight; }
    }

    public class SkinnedMeshRenderer : Component
    {
        public Mesh sharedMesh;
        public Transform[] bones;
        public float[] weights;
        public void SetBlendShapeWeight(int k, float weight) { weights[k] = weight; }
    }

    // Public fields of classes that are [Serializable], by their names; what is not there stays as it is.
    public static class JsonUtility
    {
        public static T FromJson<T>(string text)
        {
            int at = 0;
            object found = Value(text, ref at);
            Space(text, ref at);
            if (at != text.Length) throw new ArgumentException("JSON parse error");
            return (T)Shaped(found, typeof(T));
        }

        static object Shaped(object value, Type type)
        {
            if (value is List<object>)
            {
                var list = (List<object>)value;
                var array = Array.CreateInstance(type.GetElementType(), list.Count);
                for (int k = 0; k < list.Count; k++) array.SetValue(Shaped(list[k], type.GetElementType()), k);
                return array;
            }
            if (value is Dictionary<string, object>)
            {
                if (!type.IsSerializable) throw new ArgumentException(type + " is not [Serializable]");
                object made = Activator.CreateInstance(type);
                foreach (var pair in (Dictionary<string, object>)value)
                {
                    var field = type.GetField(pair.Key, BindingFlags.Public | BindingFlags.Instance);
                    if (field != null) field.SetValue(made, Shaped(pair.Value, field.FieldType));
                }
                return made;
            }
            return value == null ? null : Convert.ChangeType(value, type, CultureInfo.InvariantCulture);
        }

        static object Value(string text, ref int at)
        {
            Space(text, ref at);
            char c = at < text.Length ? text[at] : '\0';
            if (c == '{' || c == '[') return Many(text, ref at, c == '{');
            if (c == '"') return Text(text, ref at);
            int start = at;
            while (at < text.Length && "+-.eE0123456789".IndexOf(text[at]) >= 0) at++;
            if (at == start) throw new ArgumentException("JSON parse error");
            return double.Parse(text.Substring(start, at - start), CultureInfo.InvariantCulture);
        }

        static object Many(string text, ref int at, bool named)
        {
            var list = new List<object>();
            var map = new Dictionary<string, object>();
            at++;
            for (Space(text, ref at); text[at] != (named ? '}' : ']'); Space(text, ref at))
            {
                if (text[at] == ',') { at++; Space(text, ref at); }
                string key = named ? Text(text, ref at) : "";
                if (named) { Space(text, ref at); if (text[at++] != ':') throw new ArgumentException("JSON parse error"); }
                object value = Value(text, ref at);
                if (named) map[key] = value; else list.Add(value);
            }
            at++;
            return named ? (object)map : list;
        }

        static string Text(string text, ref int at)
        {
            int end = text.IndexOf('"', at + 1);
            string found = text.Substring(at + 1, end - at - 1);
            if (found.IndexOf('\\') >= 0) throw new NotSupportedException("escapes");
            at = end + 1;
            return found;
        }

        static void Space(string text, ref int at) { while (at < text.Length && char.IsWhiteSpace(text[at])) at++; }
    }
}
